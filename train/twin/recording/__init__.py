"""Drives, written as a robot would log them."""
