"""The TLS gateway, the process that accepts connections from the network."""
