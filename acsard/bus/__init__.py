"""Shell: owns the Zenoh sessions; who may join, what came in, what goes out."""
