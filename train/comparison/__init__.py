"""May two runs be compared, and what went wrong in one."""
