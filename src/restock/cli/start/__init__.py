"""The whole way in one command: a stranger's recordings (`start`) or the sample logs (`demo`)."""
