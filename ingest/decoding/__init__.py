"""Decoding of payloads into columns: message definitions; CDR, ROS 1, JSON and protobuf."""
