"""The TLS gateway (`acsard door`): a process that terminates connections from the network."""
