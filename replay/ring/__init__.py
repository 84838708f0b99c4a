"""The newest experience, in a ring with reserves."""
