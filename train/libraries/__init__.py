"""Training with other libraries, in the twin and on mixtures."""
