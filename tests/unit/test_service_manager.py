"""The daemon's messages to the service manager are correct and rare, and sending never blocks."""

from __future__ import annotations

import itertools
import os
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path

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


def test_without_a_manager_nothing_happens() -> None:
    nobody = Systemd({}, PID)
    nobody.ready()
    stepped(nobody, NS_PER_S)
    nobody.stopping()
    nobody.close()


@pytest.mark.parametrize("address", ["/no/such/socket", "relative", "@acsard-nobody-here"])
def test_an_address_without_a_listener_raises_no_error(address: str) -> None:
    nobody = Systemd({"NOTIFY_SOCKET": address}, PID)
    nobody.ready()


def test_an_abstract_socket_address_is_accepted() -> None:
    manager = Manager(f"@acsard-test-{os.getpid()}")
    try:
        systemd(manager).ready()
        assert manager.read_datagrams() == [{"READY": "1"}]
    finally:
        manager.close()


def test_the_socket_is_not_inherited_by_children(manager: Manager) -> None:
    before = sockets()
    there = systemd(manager)
    (made,) = sockets() - before
    assert not os.get_inheritable(made)
    there.close()
    assert sockets() == before


def sockets() -> set[int]:
    """Return the open sockets of this process."""
    descriptors = set()
    for fd in map(int, os.listdir("/proc/self/fd")):
        try:
            if stat.S_ISSOCK(os.fstat(fd).st_mode):
                descriptors.add(fd)
        except OSError:
            pass  # the descriptor that listed the directory
    return descriptors


# the life of a service


def test_ready_is_sent_in_one_datagram(manager: Manager) -> None:
    systemd(manager).ready()
    assert manager.read_datagrams() == [{"READY": "1"}]


def test_stopping_is_reported_with_a_status(manager: Manager) -> None:
    systemd(manager).stopping()
    assert manager.read_datagrams() == [{"STOPPING": "1", "STATUS": "ramping to zero"}]


def test_waiting_extends_the_start_timeout_by_30_s(
    manager: Manager,
) -> None:
    systemd(manager).waiting("the daemon waits for the Zenoh router")
    assert manager.read_datagrams() == [
        {"EXTEND_TIMEOUT_USEC": "30000000", "STATUS": "the daemon waits for the Zenoh router"}
    ]


def test_after_close_nothing_is_sent(manager: Manager) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    there.close()
    there.ready()
    stepped(there, NS_PER_S)
    there.close()
    assert manager.read_datagrams() == []


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


def test_the_first_step_feeds_the_watchdog(manager: Manager) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    assert len(feeds(manager, there, 10 * MS, 1)) == 1


@pytest.mark.parametrize("period_ms", [1, 10, 20, 33, 50, 100])
def test_the_watchdog_is_fed_at_its_interval_and_not_in_each_step(
    manager: Manager, period_ms: int
) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    fed = feeds(manager, there, period_ms * MS, 2000 // period_ms)
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


def test_a_watchdog_with_the_pid_of_this_process_is_fed(manager: Manager) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000", WATCHDOG_PID=str(PID))
    assert feeds(manager, there, 10 * MS, 1)


def test_only_a_step_feeds_the_watchdog(manager: Manager) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    there.ready()
    there.waiting("for the router")
    there.stopping()
    assert not [datagram for datagram in manager.read_datagrams() if "WATCHDOG" in datagram]


# the status


@pytest.mark.parametrize(
    ("twist", "text"),
    [
        (Twist(0.5, 0.0), "driving at 0.5 m/s, commanded by nav"),
        (Twist(-0.5, 0.04), "driving at -0.5 m/s, commanded by nav"),
        (Twist(0.0, -1.26), "driving at 0.0 m/s, -1.3 rad/s, commanded by nav"),
    ],
)
def test_driving_is_shown_by_its_speed_and_source(
    manager: Manager, twist: Twist, text: str
) -> None:
    stepped(systemd(manager), NS_PER_S, applied=twist)
    assert statuses(manager) == [text]


def test_any_other_mode_is_shown_by_its_name_and_reason(manager: Manager) -> None:
    stepped(systemd(manager), NS_PER_S, mode="waiting", reason="/dev/acsar is not there")
    assert statuses(manager) == ["waiting: /dev/acsar is not there"]


def test_the_same_status_is_sent_once(manager: Manager) -> None:
    there = systemd(manager)
    for step in range(1, 1000):
        stepped(there, step * 10 * MS, changed=step % 3 == 0)
    assert statuses(manager) == ["driving at 0.5 m/s, commanded by nav"]


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


def test_a_full_queue_neither_blocks_nor_raises_and_the_watchdog_is_fed_after_it(
    manager: Manager,
) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    began = time.monotonic()
    steps = fill(there)
    assert time.monotonic() - began < 5.0
    assert 0 < len(manager.read_datagrams()) < steps, "the queue was not full"
    stepped(there, 2000 * NS_PER_S)
    assert {"WATCHDOG": "1"} in manager.read_datagrams()


def test_a_manager_that_disappears_causes_no_error(manager: Manager) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    manager.close()
    os.unlink(manager.address)
    there.ready()
    stepped(there, NS_PER_S)
    there.stopping()
    there.close()


def test_a_status_that_a_full_queue_refused_is_sent_later(manager: Manager) -> None:
    there = systemd(manager, WATCHDOG_USEC="200000")
    fill(there)
    at = 2000 * NS_PER_S
    stepped(there, at, mode="stopped", reason="by teleop", changed=True)
    manager.read_datagrams()
    for step in range(1, 30):
        stepped(there, at + step * 100 * MS, mode="stopped", reason="by teleop")
    assert statuses(manager) == ["stopped: by teleop"]
