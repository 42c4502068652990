"""The daemon's messages to the service manager are correct and rare, and sending never blocks."""

from __future__ import annotations

import itertools
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acsard.core.values import NS_PER_S, Status, Twist
from acsard.host.systemd import FEEDS_PER_WATCHDOG, Systemd

PID = 4711

MS = 1_000_000

HALF = Twist(0.5, 0.0)


class Manager:
    """A stand-in for the service manager at the other end of the socket."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self._socket.setblocking(False)

    def read_datagrams(self) -> list[dict[str, str]]:
        """Return the datagrams since the last call, each as a dict of NAME=value assignments."""
        datagrams: list[dict[str, str]] = []
        while True:
            try:
                text = self._socket.recv(65536).decode()
            except BlockingIOError:
                return datagrams
            datagrams.append(dict(line.split("=", 1) for line in text.split("\n")))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(str(tmp_path / "notify"))
    yield manager
    manager.close()


def systemd(manager: Manager, **more: str) -> Systemd:
    return Systemd({"NOTIFY_SOCKET": manager.address} | more, PID)


def stepped(
    systemd: Systemd,
    at_ns: int,
    *,
    mode: str = "driving",
    reason: str = "",
    source: str = "nav",
    applied: Twist = HALF,
    changed: bool = False,
) -> None:
    status = Status(mode, "commanded", reason, "up", source)
    systemd.step(at_ns, status, applied, changed=changed)


def statuses(manager: Manager) -> list[str]:
    return [datagram["STATUS"] for datagram in manager.read_datagrams() if "STATUS" in datagram]


# the receiving socket


@pytest.mark.parametrize("address", ["", "/no/such/socket", "relative", "@acsard-nobody-here"])
def test_without_a_manager_nothing_happens(address: str) -> None:
    nobody = Systemd({"NOTIFY_SOCKET": address} if address else {}, PID)
    nobody.ready()
    stepped(nobody, NS_PER_S)
    nobody.stopping()
    nobody.close()


def test_the_life_of_a_service_is_told_in_one_datagram_each(manager: Manager) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    there.waiting("the daemon waits for the Zenoh router")  # for 30 s more
    there.ready()
    there.stopping()
    there.close()
    there.ready()
    stepped(there, NS_PER_S)
    there.close()
    # Only a step feeds the watchdog.
    assert manager.read_datagrams() == [
        {"EXTEND_TIMEOUT_USEC": "30000000", "STATUS": "the daemon waits for the Zenoh router"},
        {"READY": "1"},
        {"STOPPING": "1", "STATUS": "ramping to zero"},
    ]


# the watchdog


def feeds(manager: Manager, there: Systemd, period_ns: int, steps: int) -> list[int]:
    """Return the times of the steps that fed the watchdog."""
    fed = []
    for step in range(1, steps + 1):
        at = NS_PER_S + step * period_ns
        stepped(there, at)
        if {"WATCHDOG": "1"} in manager.read_datagrams():
            fed.append(at)
    return fed


@pytest.mark.parametrize("period_ms", [1, 10, 20, 33, 50, 100])
def test_the_watchdog_is_fed_at_its_interval_only(manager: Manager, period_ms: int) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    fed = feeds(manager, there, period_ms * MS, 2000 // period_ms)
    assert fed[0] == NS_PER_S + period_ms * MS
    gaps = [b - a for a, b in itertools.pairwise(fed)]
    least = 200 * MS // FEEDS_PER_WATCHDOG
    assert min(gaps) >= least
    assert max(gaps) < least + period_ms * MS, (
        "the watchdog is fed at the first step when it is due"
    )
    assert max(gaps) <= 100 * MS, "systemd advises to feed the watchdog at half its time"


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": ""},
        {"WATCHDOG_USEC": "-200000"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "200000", "WATCHDOG_PID": str(PID + 1)},
    ],
)
def test_a_watchdog_that_is_off_broken_or_another_process_s_is_not_fed(
    manager: Manager, environment: dict[str, str]
) -> None:
    assert feeds(manager, systemd(manager, **environment), 10 * MS, 50) == []


def test_an_abstract_socket_address_is_accepted() -> None:
    manager = Manager(f"@acsard-test-{os.getpid()}")
    try:
        systemd(manager).ready()
        assert manager.read_datagrams() == [{"READY": "1"}]
    finally:
        manager.close()


# the status


@pytest.mark.parametrize(
    ("status", "text"),
    [
        ({"applied": Twist(0.5, 0.0)}, "driving at 0.5 m/s, commanded by nav"),
        ({"applied": Twist(-0.5, 0.04)}, "driving at -0.5 m/s, commanded by nav"),
        ({"applied": Twist(0.0, -1.26)}, "driving at 0.0 m/s, -1.3 rad/s, commanded by nav"),
        ({"mode": "waiting", "reason": "/dev/acsar is not there"},
         "waiting: /dev/acsar is not there"),
    ],
)  # fmt: skip
def test_the_status_has_speed_and_source_or_mode_and_reason(
    manager: Manager, status: dict[str, Any], text: str
) -> None:
    stepped(systemd(manager), NS_PER_S, **status)
    assert statuses(manager) == [text]


def test_a_change_of_mode_is_sent_immediately(manager: Manager) -> None:
    there = systemd(manager)
    stepped(there, NS_PER_S)
    stepped(there, NS_PER_S + 10 * MS, mode="stopped", reason="by teleop", changed=True)
    assert statuses(manager) == ["driving at 0.5 m/s, commanded by nav", "stopped: by teleop"]


def test_a_change_of_speed_is_sent_at_most_once_a_second(manager: Manager) -> None:
    there = systemd(manager)
    for step in range(500):
        speed = step / 100
        stepped(there, NS_PER_S + step * 10 * MS, applied=Twist(speed, 0.0))
    assert len(statuses(manager)) == 5


# a manager that does not read


def fill(there: Systemd) -> int:
    """Run many steps, which send more messages than the socket can hold. Return their number."""
    for step in range(1, 10_000):
        stepped(there, step * 100 * MS)
    return step


def test_a_full_queue_blocks_nothing_and_the_watchdog_is_fed_after_it(
    manager: Manager,
) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    began = time.monotonic()
    steps = fill(there)
    assert time.monotonic() - began < 5.0
    assert 0 < len(manager.read_datagrams()) < steps, "the queue was not full"
    stepped(there, 2000 * NS_PER_S)
    assert {"WATCHDOG": "1"} in manager.read_datagrams()
