"""Pure: `acsard.toml` bytes -> one frozen `Config`, or errors that name the key and the mend."""
