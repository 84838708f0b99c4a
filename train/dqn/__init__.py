"""The learner: network, loss, target updates, and the config of a run."""
