"""ROS 2 over Zenoh: names, tokens, attachments and parameters of the two transports."""
