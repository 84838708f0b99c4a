"""The twin as Gymnasium environments, and its scripted drivers."""
