"""Drives in the twin, written as a robot would log them."""
