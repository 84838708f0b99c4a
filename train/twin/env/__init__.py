"""The twin as Gymnasium environments, and who can drive in it."""
