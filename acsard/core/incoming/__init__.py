"""Decodes input from the bus: samples become commands, and queries become replies or requests."""
