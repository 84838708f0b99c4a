"""Fits of the twin to logs, and measurements of the gap between twin and logs."""
