"""The learner: network, loss, target updates, checkpoints, and the config of a run."""
