"""Connects acsard to ROS 2 over zenoh-bridge-ros2dds or rmw_zenoh_cpp, without I/O."""
