"""Sends the commands of all viewers from one thread, so that no caller waits for the bus.

The ride of a viewer happens in its page or program, which has the zeros at the beginning and the
end. Each viewer has a `Relay`, which keeps only its newest command and never repeats one: the robot
stops when the person, the page or the network falls silent. When a viewer leaves, the program calls
`release()`, and the thread sends a zero if the robot may still follow, even if the bus was blocked
for long.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from queue import SimpleQueue
from threading import Event, Lock
from typing import Never

from msgspec import Struct

from acsard.client.connection import Connection
from acsard.client.ride import MAX_SOURCE_TIMEOUT_S, STALE_S
from acsard.client.signing import CommandSigner
from acsard.core.messages import schema
from acsard.core.messages.schema import Beat
from acsard.core.values import NS_PER_S, REST, Ns, Twist
from acsard.host import clock
from acsard.host.threads import Worker
from acsard.web.metrics import Counts


class Wish(Struct, frozen=True):
    """A twist that a person requests, with the time on the sender's clock, if it has one."""

    twist: Twist
    stamp_ns: Ns | None = None
    echo: Beat | None = None  # the newest beat that the person's program had received


class Relay:
    """Keeps the newest command of one sender to a source. A zero is sent even if it is old."""

    def __init__(self, source: str, signer: CommandSigner) -> None:
        self.source, self.signer = source, signer
        self._wish: Wish | None = None
        self._last = Wish(REST)  # sent or not
        self._came_ns: Ns = 0  # newest command
        self._moved_ns: Ns | None = None  # a speed was last sent; None after a zero

    @property
    def waits(self) -> bool:
        """Whether a command waits to be sent."""
        return self._wish is not None

    def take(self, wish: Wish, now_ns: Ns) -> None:
        """Store a command, which replaces one that waits."""
        self._wish = self._last = wish
        self._came_ns = now_ns

    def send(self, now_ns: Ns) -> Wish | None:
        """Return the command to send now, or None; drop a speed that is old."""
        wish, self._wish = self._wish, None
        if wish is None:
            return None
        moves = wish.twist != REST
        if moves and now_ns - self._came_ns > STALE_S * NS_PER_S:
            return None
        self._moved_ns = now_ns if moves else None
        return wish

    def end(self, now_ns: Ns, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> Wish | None:
        """End the drive, discard what waits, and return a zero to send, or None.

        After a zero, or the source's timeout since the last speed, another zero would only stop the
        next sender.
        """
        moved_ns, self._moved_ns = self._moved_ns, None
        self._wish = None
        # The timeout begins when the last command arrives at the daemon, which may take 0.1 s.
        if moved_ns is None or now_ns - moved_ns > timeout_s * NS_PER_S + NS_PER_S // 10:
            return None
        # With a stamp from another clock, the daemon would assume that the sender's clock has
        # jumped.
        stamp_ns = self._last.stamp_ns
        if stamp_ns is not None:
            stamp_ns += now_ns - self._came_ns
        return Wish(REST, stamp_ns, self._last.echo)


class Outbox:
    """Sends the newest command of each relay on the bus, once, signed by its viewer."""

    def __init__(self, client: Callable[[], Connection | None], counts: Counts) -> None:
        self._client, self._counts = client, counts
        self._queue = SimpleQueue[Callable[[], object]]()  # has each relay that waits once
        self._lock = Lock()  # of all relays
        # Gets an exception that ends the thread; otherwise pending. The server then must exit: it
        # cannot stop the robot any more when a viewer disconnects.
        self.dead: Future[Never] = Future()
        Worker("outbox", self._run, self.dead.set_exception).start()

    def take(self, relay: Relay, wish: Wish) -> None:
        """Queue a command, which replaces an unsent one of its relay."""
        with self._lock:
            waits = relay.waits
            relay.take(wish, clock.steady_ns())
        if waits:
            self._counts.add("commands_superseded")
        else:
            self._queue.put(partial(self._send, relay))

    def release(self, relay: Relay, timeout_s: float = MAX_SOURCE_TIMEOUT_S) -> None:
        """End the drive of a relay, and queue a zero if the robot may still follow it."""
        with self._lock:
            zero = relay.end(clock.steady_ns(), timeout_s)
        if zero is not None:
            self._queue.put(partial(self._publish, relay, zero))

    def flush(self, seconds: float) -> None:
        """Wait until all queued commands have been sent, but at most `seconds`."""
        sent = Event()
        self._queue.put(sent.set)
        sent.wait(seconds)

    def _run(self) -> None:
        while True:
            self._queue.get()()

    def _send(self, relay: Relay) -> None:
        with self._lock:
            waits, wish = relay.waits, relay.send(clock.steady_ns())
        if wish is not None:
            self._publish(relay, wish)
        elif waits:
            self._counts.add("commands_dropped")

    def _publish(self, relay: Relay, wish: Wish) -> None:
        try:
            client = self._client()
            if client is not None:
                twist = schema.Twist(
                    schema.Vector3(x=wish.twist.linear), schema.Vector3(z=wish.twist.angular)
                )
                zero = wish.twist == REST
                # An echo of this server would hide how late the viewer's command is.
                signature = relay.signer.sign(wish.stamp_ns, wish.echo, zero=zero)
                client.put(twist, signature, relay.source)
                self._counts.add("commands")
                return
        except Exception:  # noqa: BLE001, S110 - only this command is lost, not the thread of all viewers
            pass
        self._counts.add("commands_dropped")
