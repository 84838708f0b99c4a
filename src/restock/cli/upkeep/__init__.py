"""Verbs that keep a store in order: its files joined or repaired, recordings taken out of it."""
