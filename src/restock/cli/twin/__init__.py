"""Verbs about the twin: record in it, fit it to logs, and measure its gap to them."""
