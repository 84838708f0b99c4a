"""Review of labels: the most doubtful events for a person to look at, and the verdicts back."""
