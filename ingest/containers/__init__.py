"""Files to payloads: MCAP, rosbag2's sqlite3 and ROS 1 bags, whole, compressed or damaged."""
