"""A failure is not yet a verdict if no core was free."""

from __future__ import annotations

import os

from tests.system.cores import Idle, idle, taken


def test_where_a_core_was_free_for_a_while_a_failure_counts() -> None:
    cores = os.cpu_count() or 1
    assert taken(Idle(100.0, 7.0), Idle(110.0, 7.0))
    assert taken(Idle(100.0, 7.0), Idle(110.0, 7.0 + 0.2 * cores))
    assert not taken(Idle(100.0, 7.0), Idle(110.0, 7.0 + 0.4 * cores))


def test_it_is_counted_as_the_kernel_counts() -> None:
    first = idle()
    assert 0.0 <= first.idle_s <= first.at * (os.cpu_count() or 1) * 1.1
    assert idle() >= first
