"""A first profile for a robot nobody has described yet."""
