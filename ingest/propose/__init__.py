"""Propose a first profile for an unknown robot, from what its recordings show."""
