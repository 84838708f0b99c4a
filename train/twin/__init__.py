"""The MuJoCo twin of a warehouse robot; it knows no learner."""
