"""The unit in a real systemd, booted in a container of its own."""
