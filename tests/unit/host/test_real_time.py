"""Tests of the request for real-time scheduling. Each test runs it in a separate process."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.unit.host.privileges import WITHOUT_RAISING_LIMITS

REQUEST = """\
import resource
from acsard.host import real_time

resource.setrlimit(resource.RLIMIT_RTTIME, ({hard_us}, {hard_us}))
asked = real_time.request()
print("real-time scheduling" in asked, *resource.getrlimit(resource.RLIMIT_RTTIME))
"""


@pytest.mark.parametrize(("hard_us", "low"), [(200_000, True), (700_000, False)])
def test_a_low_hard_limit_of_real_time_work_does_not_end_the_daemon(
    hard_us: int, low: bool
) -> None:
    """With a `low` limit, the process stays without real-time scheduling."""
    done = subprocess.run(
        [*WITHOUT_RAISING_LIMITS, sys.executable, "-c", REQUEST.format(hard_us=hard_us)],
        capture_output=True,
        text=True,
        timeout=30.0,
        check=False,
    )
    refused, *limits = done.stdout.split()
    assert (limits, done.stderr) == ([str(hard_us)] * 2, "")
    assert refused == "True" or not low  # the other case needs a permission
