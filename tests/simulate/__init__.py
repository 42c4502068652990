"""Random plans against the whole daemon in virtual time: `python -m tests.simulate --help`."""
