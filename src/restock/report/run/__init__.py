"""The report and the replay card of a run: what it was fed, what it learnt, where it fails."""
