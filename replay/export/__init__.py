"""Transitions as data sets of other libraries."""
