"""How well a policy drives, or would drive."""
