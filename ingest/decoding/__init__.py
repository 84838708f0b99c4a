"""Payloads to columns: message definitions, and decoders of CDR, JSON, protobuf and ROS 1."""
