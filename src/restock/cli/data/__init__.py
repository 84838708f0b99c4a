"""Verbs about recordings, stores and panels: from logs to what a run samples from."""
