"""Judges: may runs be compared, which did better, what went wrong in one, are its rows right."""
