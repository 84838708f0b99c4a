"""How a robot moves and what it senses: the MuJoCo model, traffic, friction, perturbations."""
