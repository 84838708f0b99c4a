"""Build batches, and record what they contained."""
