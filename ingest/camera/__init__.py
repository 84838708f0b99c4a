"""Frames of a robot's cameras: what their messages hold, and those in force at steps."""
