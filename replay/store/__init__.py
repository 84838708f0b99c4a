"""A store, open for reading: views, queries, audits."""
