"""`acsard doctor`: diagnoses this machine and suggests fixes. The package does I/O."""
