"""Judge runs: whether they may be compared, which did better, what went wrong, and its rows."""
