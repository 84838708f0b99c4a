"""Proposes a first profile for an unknown robot from its recordings."""
