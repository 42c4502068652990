"""Pure: decodes `acsard.toml` to one frozen `Config`, or to errors that name each key and its
fix.
"""
