"""A running robot: messages as they come, the policy's command, the ROS 2 node around them."""
