"""`acsard mcu check`: proves the microcontroller's side, step by step, without I/O of its own."""
