"""Makes `python -m acsard` the same as `acsard`."""

from acsard.cli import entry

entry()
