"""The rules for exchanging messages with ROS 2 over zenoh-bridge-ros2dds or rmw_zenoh_cpp.

This package does no I/O itself.
"""
