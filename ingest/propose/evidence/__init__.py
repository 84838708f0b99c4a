"""What a recording says of its robot: which topic is for what, and each choice with its reason."""
