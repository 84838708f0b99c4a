"""The twin as Gymnasium environments."""
