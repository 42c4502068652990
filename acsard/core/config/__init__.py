"""Decodes `acsard.toml` to a frozen `Config`, or to errors that name each key and its fix."""
