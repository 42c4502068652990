"""The processes that accept connections from the network: the TLS gateway and a fleet's router."""
