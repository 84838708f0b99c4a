"""The MuJoCo twin of a warehouse robot, independent of any learner."""
