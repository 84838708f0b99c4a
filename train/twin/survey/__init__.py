"""Surveys: floors of the twin made from the maps, scans and poses of recordings."""
