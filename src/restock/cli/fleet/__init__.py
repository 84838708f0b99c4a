"""Verbs about a whole store: its coverage, what differs, its labels, and keeping it in order."""
