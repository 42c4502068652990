"""The Zenoh sessions: access rules, receiving, publishing and replying."""
