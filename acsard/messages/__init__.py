"""What goes over the bus, pure: structs, the topic table, encodings, and both directions."""
