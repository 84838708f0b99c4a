"""How recordings lie in bytes: the records and chunks of MCAP, the pages of SQLite."""
