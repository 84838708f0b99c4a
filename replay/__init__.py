"""Replay: what is in the store, what is missing, and what a learner is fed from it."""
