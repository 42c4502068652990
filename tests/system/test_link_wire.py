"""An independent serial peer checks the bytes that the daemon sends."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.system.bystander import lost
from tests.system.harness import (
    STANDING,
    ZERO,
    ZERO_LINE,
    Bus,
    Daemon,
    Peer,
    Tables,
    twist,
    until,
    wheels,
)


@contextmanager
def running(
    tmp_path: Path, peer: Peer, config: Tables | None = None, linked: bool = True
) -> Iterator[Bus]:
    with Daemon(tmp_path, peer.path, config) as daemon, Bus(daemon.endpoint) as bus:
        if linked:
            bus.linked()
        yield bus


class Started(NamedTuple):
    """Lines that a board received at a start, a straight drive at 0.5 m/s and a turn at 1 rad/s."""

    stream: bytes
    """Every byte up to the end of the straight drive."""
    lines: list[bytes]
    straight: bytes
    """The steady line of the straight drive."""
    left: bytes
    """The steady line of the turn."""
    turned: float
    """Odometry's greatest yaw of the turn, rad."""


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Started:
    where = tmp_path_factory.mktemp("started")

    def steady(*others: bytes) -> bytes | None:
        """Return the first line outside `others` that the board received thirty times in a row."""
        for line, same in itertools.groupby(peer.session.raw_lines()):
            if line not in others and sum(1 for _ in same) >= 30:
                return line
        return None

    def drives(linear: float, angular: float, *others: bytes) -> bytes | None:
        # A machine that stands still for a second silences this sender, which must then send a zero
        # first. It may also deliver our replies in one burst, which no wheel could produce.
        state = bus.state()
        yaws.append(state["yaw"])
        if state["mode"] == "fault":
            assert lost(begun) > 0.05, state
            bus.get("srv/clear")
        waits = state["code"] == "neutral"
        sender.wish = ZERO if waits else twist(linear, angular)
        return steady(ZERO_LINE, *others)

    begun, yaws = time.monotonic(), [0.0]
    with Peer(where / "mcu") as peer, running(where, peer) as bus, bus.commanding(0.5) as sender:
        straight = until(lambda: drives(0.5, 0.0), 5.0, "steady driving")
        stream, lines = peer.session.stream, peer.session.raw_lines()
        left = until(lambda: drives(0.0, 1.0, straight), 5.0, "steady turning")
        yaws.append(bus.state()["yaw"])
        return Started(stream, lines, straight, left, max(yaws))


def test_the_first_bytes_are_an_end_of_line_and_a_zero_and_every_line_has_33_bytes(
    started: Started,
) -> None:
    first, *lines = started.lines
    assert started.stream.startswith(b"\r\n" + ZERO_LINE)
    assert first == b"\r\n"
    assert lines[0] == ZERO_LINE
    assert {len(line) for line in lines} == {33}


def test_half_a_metre_per_second_straight_is_10_rad_per_s_on_every_wheel(started: Started) -> None:
    assert started.straight == b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"


def test_a_pure_left_turn_is_forward_on_a_and_d_and_backward_on_b_and_c(started: Started) -> None:
    # 1 rad/s on half of 0.30 m is 0.15 m/s, over 0.05 m 3 rad/s.
    assert started.left == b"ap03.00,bn03.00,cn03.00,dp03.00\r\n"
    assert started.turned > 0.1


def test_speeds_on_the_wire_grow_by_the_acceleration_limit_only(started: Started) -> None:
    # 1 m/s2 is 20 rad/s2; a step is at most 0.05 s however late the tick came.
    sped = [wheels(line)[0] for line in started.lines[1:]]
    assert max(after - before for before, after in itertools.pairwise(sped)) <= 20 * 0.05 + 0.01


@pytest.mark.slow
def test_a_trailing_comma_and_wired_signs_and_letters_apply_on_the_wire(
    tmp_path: Path, peer: Peer
) -> None:
    config: Tables = {
        "mcu": {"port": str(peer.path), "trailing_comma": True},
        "mcu.wheels": {
            "front_right": "-b", "front_left": "+a", "rear_left": "+c", "rear_right": "+d",
        },
    }  # fmt: skip
    with running(tmp_path, peer, config) as bus, bus.commanding(0.5):
        steady = b"ap10.00,bn10.00,cp10.00,dp10.00,\r\n"
        until(lambda: peer.lines[-1].line == steady, 5.0, f"{steady!r} on the wire")
        until(lambda: bus.state()["linear"] == pytest.approx(0.5), 5.0, "0.5 m/s measured")
    first, *lines = peer.session.raw_lines()
    assert first == b"\r\n"
    assert wheels(lines[0]) == STANDING
    assert {(line[-3:], len(line)) for line in lines} == {(b",\r\n", 34)}
