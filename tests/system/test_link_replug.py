"""When the board's cable is pulled and put back, the daemon reports it and sends no old speed."""

from __future__ import annotations

import os
import pty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.system.bystander import lost
from tests.system.harness import ZERO, ZERO_LINE, Peer, running, twist, until, wheels

pytestmark = pytest.mark.slow

SEEN_S = 0.02
"""SAFETY: an unplugged port is seen this fast."""

SLACK_S = 0.5
"""The time that a noisy two-core machine may add to a bound before a test calls it broken."""


@contextmanager
def pty_name_occupied(name: str) -> Iterator[None]:
    """Occupy the pty of this name, so that the next program that opens a pty gets another name."""
    kept: list[int] = []

    def hold() -> bool:
        # The name is free once the daemon has closed its end, too. Others may be free before it.
        pairs = [pty.openpty() for _ in range(8)]
        for ends in pairs:
            if os.ttyname(ends[1]) == name:
                kept.extend(ends)
            else:
                for end in ends:
                    os.close(end)
        return bool(kept)

    until(hold, 5.0, f"{name} is free")
    try:
        yield
    finally:
        for end in kept:
            os.close(end)


def kinds_of(pid: int) -> tuple[int, int]:
    """Return the number of file descriptors and of threads of a process."""
    return len(os.listdir(f"/proc/{pid}/fd")), len(os.listdir(f"/proc/{pid}/task"))


def test_unplug_and_replug_while_driving_says_so_reconnects_and_sends_nothing_old(
    tmp_path: Path, peer: Peer
) -> None:
    with (
        running(tmp_path, peer.path) as (daemon, bus),
        bus.follow("state") as states,
        bus.commanding(0.5) as commander,
    ):
        until(lambda: peer.lines[-1].line.startswith(b"ap10.00"), 5.0, "steady driving")
        moved = bus.state()["x"]
        pulled = peer.unplug()
        down = states.find(lambda state: state["link"] == "down", 5.0, "down", after=pulled)
        print(f"unplug -> link down in state: {(down.at - pulled) * 1e3:.1f} ms")
        assert down.at - pulled < SEEN_S + SLACK_S + lost(pulled, down.at)
        assert str(peer.path) in down.value["reason"], "lost, or by now not there"
        assert down.value["mode"] == "waiting"
        assert until(lambda: daemon.events("port_lost"), 2.0, "a log line")
        peer.plug()
        up = states.find(lambda state: state["link"] == "up", 5.0, "up", after=down.at)
        first = peer.session.raw[0].at - peer.session.plugged
        print(f"replug -> first bytes {first:.3f} s, up {up.at - peer.session.plugged:.3f} s")
        assert first < 0.5 + SLACK_S + lost(down.at, up.at)
        assert peer.session.stream.startswith(b"\r\n" + ZERO_LINE)
        # The commander has never stopped sending, and never sent a zero.
        states.find(lambda state: state["code"] == "neutral", 5.0, "why", after=up.at)
        peer.await_lines(100)
        assert set(peer.session.raw_lines()[1:]) == {ZERO_LINE}
        commander.wish = ZERO
        until(lambda: bus.state()["code"] != "neutral", 5.0, "the zero was received")
        assert set(peer.session.raw_lines()[1:]) == {ZERO_LINE}
        zeros = 1

        def drives() -> bool:
            """Return whether the board receives the speed. Send a zero if the daemon asks for one.

            The daemon asks for a zero if the robot stood still for a second.
            """
            nonlocal zeros
            before = commander.wish
            commander.wish = ZERO if bus.state()["code"] == "neutral" else twist(0.5)
            zeros += commander.wish == ZERO != before
            return peer.lines[-1].line.startswith(b"ap10.00")

        until(drives, 5.0, "driving again")
        ramp = [wheels(line)[0] for line in peer.session.raw_lines()[1:]]
        # The exception is a kernel thread, which carries bytes through a pty, that had no core
        # for that time.
        if zeros == 1 and not any(event["text"] for event in daemon.events("link_stale")):
            assert ramp == sorted(ramp), "it grew from zero by its ramp"
        assert bus.state()["x"] > moved, "odometry went on from where it was"


def test_a_replug_under_another_name_leaks_nothing_and_releases_no_stop(
    tmp_path: Path, peer: Peer
) -> None:
    with running(tmp_path, peer.path) as (daemon, bus), bus.follow("state") as states:
        assert bus.get("srv/stop")["success"]
        before = (0, 0)
        for cycle in range(3):
            name = os.readlink(peer.path)
            pulled = peer.unplug()
            states.find(lambda state: state["link"] == "down", 5.0, "down", after=pulled)
            with pty_name_occupied(name):
                peer.plug()
            assert os.readlink(peer.path) != name
            states.find(lambda state: state["link"] == "up", 5.0, "up", after=pulled)
            if cycle == 0:  # the first loss may start a thread that stays
                before = kinds_of(daemon.pid)
        until(lambda: kinds_of(daemon.pid) <= before, 3.0, f"no more than {before}")
        with bus.commanding(0.5):
            peer.await_lines(50)
            assert bus.state()["mode"] == "stopped"
        assert set(peer.session.raw_lines()[1:]) == {ZERO_LINE}
