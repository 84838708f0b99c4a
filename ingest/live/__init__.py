"""A running robot: observations from live messages, the policy's decisions, the ROS 2 node."""
