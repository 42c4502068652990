"""The keys, tokens and bytes for ROS 2 over zenoh-bridge-ros2dds or rmw_zenoh_cpp. No I/O."""
