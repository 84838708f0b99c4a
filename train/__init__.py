"""Train: the twin, the learner, and the record of what it was fed."""
