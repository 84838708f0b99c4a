"""Verbs for a team's own continuous integration: one gate over audits, differences and runs."""
