"""Random tests of the whole daemon in virtual time: `python -m tests.simulate --help`.

A plan contains the configuration, the senders and the events of one run.
"""
