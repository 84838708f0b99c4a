"""Other libraries trained in the twin and on the mixtures."""
