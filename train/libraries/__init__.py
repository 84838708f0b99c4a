"""Other libraries in the twin and on the mixtures."""
