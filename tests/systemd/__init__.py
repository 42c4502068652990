"""Tests of the systemd units in a real systemd, which boots in a container."""
