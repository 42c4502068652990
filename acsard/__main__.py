"""`python -m acsard` is `acsard`."""

from acsard.cli import entry

entry()
