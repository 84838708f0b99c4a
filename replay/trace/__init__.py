"""Trace a sampled row back to the messages from which it was made."""
