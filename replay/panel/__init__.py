"""Build panels: pinned sets of packed rows from a store and a mixture; sample their rows."""
