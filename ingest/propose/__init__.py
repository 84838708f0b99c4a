"""A first profile for an unknown robot."""
