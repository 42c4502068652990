"""Tests the microcontroller step by step, for `acsard mcu check`. This package does no I/O."""
