"""A mixture and a store become a pinned set of packed rows."""
