"""Verbs of a running robot: the policy as a ROS 2 node, in shadow or driving."""
