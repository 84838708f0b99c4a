"""Verbs about a whole store: its coverage, differences, labels and maintenance."""
