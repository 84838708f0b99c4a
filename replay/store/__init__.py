"""Read a store: its views, queries and audits."""
