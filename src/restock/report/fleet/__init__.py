"""Pages about a store: what it holds, what is missing, and which robot has changed."""
