"""Pages about runs: the report and replay card of one, a comparison of two, a study of many."""
