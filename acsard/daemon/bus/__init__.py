"""Shell package that owns the Zenoh sessions: access rules, receiving, publishing and replying."""
