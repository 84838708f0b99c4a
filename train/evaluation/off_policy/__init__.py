"""Episodes that a panel holds out, and what estimators make of them for another policy."""
