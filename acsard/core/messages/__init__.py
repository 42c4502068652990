"""The messages on the bus: types, table of keys, encodings, reports and signatures. Does no I/O."""
