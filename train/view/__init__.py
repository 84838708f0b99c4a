"""A moment of a recording in the tools that people look with: Foxglove and Rerun."""
