"""Mixture files (which transitions a learner samples, in which shares) and the shares of a run."""
