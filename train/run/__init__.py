"""A run directory: its files, tables, events and checkpoints."""
