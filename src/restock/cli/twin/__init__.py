"""Verbs about the simulated warehouse: record in it, fit it to logs, measure how far it is."""
