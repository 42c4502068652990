"""ROS 2 over Zenoh, pure: names, tokens and attachments of its two transports."""
