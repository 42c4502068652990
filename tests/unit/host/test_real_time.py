"""Tests of the request for real-time scheduling, in processes of their own."""

from __future__ import annotations

import subprocess
import sys

from tests.unit.host.privileges import WITHOUT_RAISING_LIMITS

REQUEST = """\
import resource
from acsard.host import real_time

resource.setrlimit(resource.RLIMIT_RTTIME, (200_000, 200_000))
real_time.request()
print(*resource.getrlimit(resource.RLIMIT_RTTIME))
"""


def test_a_low_hard_limit_of_real_time_work_does_not_keep_the_daemon_from_starting() -> None:
    done = subprocess.run(
        [*WITHOUT_RAISING_LIMITS, sys.executable, "-c", REQUEST],
        capture_output=True,
        text=True,
        timeout=30.0,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("200000 200000\n", "")
