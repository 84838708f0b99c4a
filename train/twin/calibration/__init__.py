"""The twin fitted to logs, and how far it is from them."""
