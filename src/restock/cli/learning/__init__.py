"""Verbs about runs: train, evaluate, compare, trace, diagnose and report."""
