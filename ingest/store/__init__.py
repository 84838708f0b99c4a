"""Writer of a store's Delta tables, and everything else that reads or changes their files."""
