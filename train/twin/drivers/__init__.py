"""The twin's drivers: planner, operator, random actions, and handover between them."""
