"""What the service manager is told: ready, alive, how it goes, going down.

Without one (`$NOTIFY_SOCKET` unset) nothing is sent. The protocol is sd_notify's: a datagram of
`NAME=value` lines. `WATCHDOG=1` comes from the control step itself: a loop that stands still is
silent, and systemd ends it.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping

from acsard.values import NS_PER_S, Outputs

FEEDS_PER_WATCHDOG = 4
"""How often the watchdog is fed within its time; it is no timer of a late loop's leisure."""

STATUS_PERIOD_NS = NS_PER_S

PATIENCE_S = 30
"""By how much a start that waits for something asks systemd to wait with it."""


class Systemd:
    """The service manager of this process, if there is one."""

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

    @property
    def present(self) -> bool:
        """Somebody listens."""
        return self._socket is not None

    def ready(self) -> None:
        """The start is over."""
        self._send("READY=1")

    def stopping(self) -> None:
        """The way down has begun: the watchdog need not be fed any more."""
        self._send("STOPPING=1\nSTATUS=ramping to zero")

    def waiting(self, why: str) -> None:
        """The start waits for something; called again before `PATIENCE_S` is over."""
        self._send(f"EXTEND_TIMEOUT_USEC={PATIENCE_S * 1_000_000}\nSTATUS={why}")

    def status(self, text: str) -> None:
        """How it goes, for `systemctl status`."""
        self._send(f"STATUS={text}")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def step(self, outputs: Outputs) -> None:
        """After each control step: alive, and how it goes when that has changed."""
        if self._socket is None:
            return
        now_ns = outputs.now.mono_ns
        if self._feed_every_ns and now_ns - self._fed_ns >= self._feed_every_ns:
            self._fed_ns = now_ns
            self.alive()
        if outputs.status_changed or now_ns - self._status_ns >= STATUS_PERIOD_NS:
            self._status_ns = now_ns
            status = status_of(outputs)
            if status != self._status and self._send(f"STATUS={status}"):
                self._status = status

    def close(self) -> None:
        """Nothing more to say."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.send(text.encode())
        except OSError:
            return False  # its queue is full or it is gone: the robot drives on
        return True


def status_of(outputs: Outputs) -> str:
    """One line for `systemctl status`."""
    if outputs.mode == "driving":
        twist = outputs.applied
        turn = f", {twist.angular:.1f} rad/s" if abs(twist.angular) >= 0.05 else ""
        return f"driving {twist.linear:.1f} m/s{turn} by {outputs.source}"
    return f"{outputs.mode}: {outputs.reason}"
