"""The rules for exchanging messages with ROS 2 over zenoh-bridge-ros2dds or rmw_zenoh_cpp.

This package only computes keys, tokens and bytes. It does no I/O.
"""
