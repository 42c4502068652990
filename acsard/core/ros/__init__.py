"""ROS 2 over Zenoh, pure: names, tokens, attachments and parameters of its two transports."""
