"""Paths to recordings: found, opened, and read topic by topic into columns."""
