"""Pages about runs: report and replay card of a run, comparison of two, study of many."""
