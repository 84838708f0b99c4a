"""Transitions and manifest, written to a Delta table in one commit."""
