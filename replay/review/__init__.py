"""Review of labels by people: doubtful events, data to show for each, and verdicts."""
