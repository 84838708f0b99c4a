"""Who drives in the twin: planner, operator, random actions, and who takes over from whom."""
