"""`python -m acsard` is `acsard`."""

import sys

from acsard.cli import main

sys.exit(main())
