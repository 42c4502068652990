"""Zenoh sessions, addresses, certificates and subscriptions, for the daemon and for its clients."""
