"""Containers: finds recordings, opens them, and reads their topics into columns."""
