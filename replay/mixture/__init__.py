"""Mixtures: which transitions a learner samples, in which shares, as a file."""
