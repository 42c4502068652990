"""Helper for tests of processes that may not raise their resource limits."""

from __future__ import annotations

import os

WITHOUT_RAISING_LIMITS = ("setpriv", "--bounding-set", "-sys_resource") if os.geteuid() == 0 else ()
"""Words before a command, with which the command does not have CAP_SYS_RESOURCE.

Only root has this capability.
"""
