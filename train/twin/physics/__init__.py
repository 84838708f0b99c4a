"""Robot motion and sensing: the MuJoCo model, traffic, friction, perturbations."""
