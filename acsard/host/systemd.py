"""Informs systemd that this process is ready, alive or stopping, and about its status.

The protocol is that of sd_notify: a datagram with lines `NAME=value`. The control loop itself sends
`WATCHDOG=1`, so systemd ends the process if the loop hangs.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping

from acsard.core.formatting import after_mode
from acsard.core.values import NS_PER_S, Ns, Status, Twist

FEEDS_PER_WATCHDOG = 4  # within the watchdog's timeout

# Each call of `waiting` adds this before systemd ends a process that is still starting.
START_EXTENSION_S = 30


class Systemd:
    """Connection to systemd. If systemd did not start this process, the methods do nothing."""

    def __init__(self, environ: Mapping[str, str], pid: int) -> None:
        self._socket: socket.socket | None = None
        address = environ.get("NOTIFY_SOCKET", "")
        if address:
            self._connect("\0" + address[1:] if address.startswith("@") else address)
        watched = environ.get("WATCHDOG_PID", str(pid)) == str(pid)
        watchdog_us = environ.get("WATCHDOG_USEC", "0") if watched else "0"
        us = int(watchdog_us) if watchdog_us.isdigit() else 0
        self._feed_every_ns = us * 1000 // FEEDS_PER_WATCHDOG
        self._fed_ns = self._status_ns = 0
        self._status = ""

    def _connect(self, address: str) -> None:
        made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        made.setblocking(False)
        try:
            made.connect(address)
        except OSError:
            made.close()
            return
        self._socket = made

    def ready(self) -> None:
        self._send("READY=1")

    def stopping(self) -> None:
        """Report that the daemon is ending. systemd then no longer expects signs of life."""
        self._send("STOPPING=1\nSTATUS=ramping to zero")

    def waiting(self, why: str) -> None:
        """Report why the start takes longer; repeat it within `START_EXTENSION_S`."""
        self._send(f"EXTEND_TIMEOUT_USEC={START_EXTENSION_S * 1_000_000}\nSTATUS={why}")

    def status(self, text: str) -> None:
        self._send(f"STATUS={text}")

    def alive(self) -> None:
        self._send("WATCHDOG=1")

    def step(self, now_ns: Ns, status: Status, applied: Twist, *, changed: bool) -> None:
        """Feed systemd's watchdog if due, and report a changed status, after each control step."""
        if self._socket is None:
            return
        if self._feed_every_ns and now_ns - self._fed_ns >= self._feed_every_ns:
            self._fed_ns = now_ns
            self.alive()
        if changed or now_ns - self._status_ns >= NS_PER_S:
            self._status_ns = now_ns
            text = status_text(status, applied)
            if text != self._status and self._send(f"STATUS={text}"):
                self._status = text

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.send(text.encode())
        except OSError:
            # The service manager's queue is full, or the manager has ended. The robot drives on.
            return False
        return True


def status_text(status: Status, applied: Twist) -> str:
    if status.mode == "driving":
        turn = f", {applied.angular:.1f} rad/s" if abs(applied.angular) >= 0.05 else ""
        return f"driving at {applied.linear:.1f} m/s{turn}, commanded by {status.source}"
    return after_mode(status.mode, status.reason)
