"""The processes that accept connections from the network: TLS gateway and router of a fleet."""
