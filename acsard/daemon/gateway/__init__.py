"""The processes that are open to the network: the TLS gateway and the router of a fleet."""
