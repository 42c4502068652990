"""Programs for developers, run as `python -m tests.tools.NAME`."""
