"""Analyse a fleet's stores: drift, differences of two stores or panels, and what to log next."""
