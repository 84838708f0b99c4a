"""Verbs whose answer is a page: the report of a run, the coverage of a store."""
