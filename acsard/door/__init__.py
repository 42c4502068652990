"""The TLS gateway (`acsard door`): a separate process that terminates connections from the
network.
"""
