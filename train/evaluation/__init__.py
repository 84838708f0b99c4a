"""Evaluate policies: in the twin, and off-policy on logs."""
