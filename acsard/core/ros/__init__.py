"""Connects acsard to ROS 2 over Zenoh: names, tokens, attachments and parameters.

There are two transports: zenoh-bridge-ros2dds and rmw_zenoh_cpp. The package does no input or
output.
"""
