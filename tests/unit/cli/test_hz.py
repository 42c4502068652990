"""Tests of rate and jitter of arrival times against figures worked out by hand."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from acsard.cli import hz
from acsard.cli.hz import rate


@pytest.mark.parametrize("times", [[], [3.0]])
def test_fewer_than_two_messages_have_no_rate(times: list[float]) -> None:
    assert rate(times) == {"count": len(times), "hz": 0.0}


def test_the_figures_of_three_messages_equal_those_computed_by_hand() -> None:
    # The gaps are 10 and 20 ms: mean 15, deviation 5, and the 99th percentile lies 99 % of the way
    # up.
    assert rate([1.0, 1.01, 1.03]) == {
        "count": 3,
        "hz": 66.67,
        "gap_min_ms": 10.0,
        "gap_p50_ms": 15.0,
        "gap_p99_ms": 19.9,
        "gap_max_ms": 20.0,
        "gap_std_ms": 5.0,
    }


def test_an_even_stream_has_even_gaps() -> None:
    figures = rate([100.0 + n / 100 for n in range(1000)])
    assert figures["count"] == 1000
    assert figures["hz"] == 100.0
    assert figures["gap_min_ms"] == figures["gap_p50_ms"] == figures["gap_max_ms"] == 10.0
    assert figures["gap_std_ms"] == 0.0


def test_one_hole_shows_in_the_largest_gap_and_hardly_in_the_median() -> None:
    figures = rate([n / 100 + (0.5 if n >= 500 else 0.0) for n in range(1000)])
    assert figures["gap_max_ms"] == 510.0
    assert figures["gap_p50_ms"] == figures["gap_p99_ms"] == 10.0
    assert figures["hz"] == pytest.approx(999 / 10.49, abs=0.01)


def test_messages_of_one_instant_have_no_rate() -> None:
    assert rate([1.0, 1.0]) == {"count": 2, "hz": 0.0}


def test_a_line_covers_ten_seconds_of_a_fast_stream(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The clock is virtual, and 2000 messages arrive in each second."""
    now, takes = [0.0], list[Callable[[Any], None]]()

    def sleep(seconds: float) -> None:
        for _ in range(round(2000 * seconds)):
            now[0] += 1 / 2000
            takes[0](None)

    def listen(_: str, take: Callable[[Any], None]) -> SimpleNamespace:
        takes.append(take)
        return SimpleNamespace(undeclare=lambda: None)

    monkeypatch.setattr(hz, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    monkeypatch.setattr(hz, "connected", lambda _: nullcontext(SimpleNamespace(listen=listen)))
    monkeypatch.setattr(hz, "silence_explained", lambda *_: nullcontext(lambda: None))
    assert hz.main(Namespace(topic="odom", n=12, json=True)) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["count"] == pytest.approx(20_000, abs=1)
    assert last["hz"] == 2000.0
