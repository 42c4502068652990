"""Tests of blocking calls that run in threads of their own."""

from __future__ import annotations

import asyncio
import threading

import pytest

from acsard.host.threads import in_thread

NO_ROOM = 1 << 46
"""Stack size that no machine can provide, so that a thread with it cannot start."""


def test_where_no_thread_is_to_be_had_it_is_as_late_as_one_that_hangs() -> None:
    usual = threading.stack_size(NO_ROOM)
    try:
        with pytest.raises(TimeoutError, match="cannot start another thread"):
            asyncio.run(in_thread(lambda: 1, None))
    finally:
        threading.stack_size(usual)
    assert asyncio.run(in_thread(lambda: 1, None)) == 1
