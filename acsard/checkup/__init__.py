"""`acsard mcu check`: tests the microcontroller step by step. The package itself does no I/O."""
