"""Show a moment of a recording in Foxglove and Rerun."""
