"""Ingest: recordings become labelled transitions. Imports nothing of `replay` or `train`."""
