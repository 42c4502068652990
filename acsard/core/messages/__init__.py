"""Messages on the bus, pure: structs, the topic table, encodings, reports and signatures."""
