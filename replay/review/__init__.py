"""People's review of labels: events in doubt, what is shown of each, and their verdicts."""
