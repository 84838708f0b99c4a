"""All stages in one command: on a user's recordings (`start`) or the sample logs (`demo`)."""
