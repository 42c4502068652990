"""Two simulated hosts with a cable between them. Each is a network namespace.

They need root and the program `ip`.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from tests.system.harness import P

ROBOT_AT, STRANGER_AT = "198.18.77.1", "198.18.77.2"

CARDS = {ROBOT_AT: "02:00:00:00:77:01", STRANGER_AT: "02:00:00:00:77:02"}

NOBODY = "02:00:00:00:77:99"
"""The address of a network card that does not exist."""

CLONE_NEWNET = 0x40000000

_libc = ctypes.CDLL(None, use_errno=True)


class Hosts:
    """The robot's host and another host."""

    def __init__(self) -> None:
        tag = f"acsard{os.getpid()}"
        self.robot, self.stranger = f"{tag}r", f"{tag}s"
        self.address = ROBOT_AT

    def __enter__(self) -> Hosts:
        try:
            for name in (self.robot, self.stranger):
                ip("netns", "add", name)
                ip("-n", name, "link", "set", "lo", "up")
            cable = ("link", "add", "cable", "type", "veth", "peer", "name", "cable")
            ip("-n", self.robot, *cable, "netns", self.stranger)
            for name, at in ((self.robot, ROBOT_AT), (self.stranger, STRANGER_AT)):
                ip("-n", name, "link", "set", "cable", "address", CARDS[at])
                ip("-n", name, "address", "add", f"{at}/24", "dev", "cable")
                ip("-n", name, "link", "set", "cable", "up")
                # Scouting only works if there is a route for multicast.
                ip("-n", name, "route", "add", "default", "dev", "cable")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        for name in (self.robot, self.stranger):
            ip("netns", "delete", name, check=False)

    def cut(self) -> None:
        """Cut the network silently: each host then sends to a network card that does not exist.

        Nothing arrives, and no program gets an error. The direction to the robot is cut first.
        """
        self._add_neighbour(self.stranger, ROBOT_AT, NOBODY)
        self._add_neighbour(self.robot, STRANGER_AT, NOBODY)

    def heal(self) -> None:
        """Restore the network."""
        self._add_neighbour(self.stranger, ROBOT_AT, CARDS[ROBOT_AT])
        self._add_neighbour(self.robot, STRANGER_AT, CARDS[STRANGER_AT])

    @staticmethod
    def _add_neighbour(host: str, to: str, card: str) -> None:
        ip("-n", host, "neighbour", "replace", to, "lladdr", card, "dev", "cable",
           "nud", "permanent")  # fmt: skip


@contextmanager
def inside(host: str) -> Iterator[None]:
    """Move this thread to that host while the body runs.

    Sockets and processes that the thread creates meanwhile are on that host, too.
    """
    with open("/proc/thread-self/ns/net") as back, open(f"/run/netns/{host}") as there:
        _enter(there.fileno())
        try:
            yield
        finally:
            _enter(back.fileno())


@contextmanager
def on(host: str, program: P) -> Iterator[P]:
    """Run a program on that host."""
    with ExitStack() as stack:
        with inside(host):
            stack.enter_context(program)
        yield program


def _enter(namespace: int) -> None:
    if _libc.setns(namespace, CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "no way into that network namespace")


def ip(*arguments: str, check: bool = True) -> None:
    """Run the program `ip` with these arguments. Fails on an error if `check` is set."""
    subprocess.run(["ip", *arguments], check=check, capture_output=True, timeout=10.0)


def two_hosts() -> Iterator[Hosts]:
    """Provide two hosts for a fixture. Skips if the machine does not allow it."""
    if shutil.which("ip") is None or os.geteuid() != 0:
        pytest.skip("needs ip and root, to make a second host")
    try:
        entered = Hosts().__enter__()
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
    try:
        yield entered
    finally:
        entered.__exit__()
