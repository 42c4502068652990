"""Puts the velocity commands of all viewers on the bus.

A command is sent once, with the stamp of its sender, or it is dropped. The server repeats nothing
and makes up nothing, except one zero command for a sender that was driving and disconnected.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from acsard.client import Client
from acsard.client.commander import Commander, Sender, Wish
from acsard.client.outbox import Outbox
from acsard.core.messages.schema import Twist, Vector3
from acsard.core.values import REST
from acsard.host import clock
from acsard.host.rate_limits import Buckets
from acsard.web.counts import Counts
from acsard.web.limits import COMMANDS


class Hand:
    """Sends the newest command of each viewer.

    `client` returns the connection to the bus, or None while it is lost.
    """

    def __init__(self, client: Callable[[], Client | None], counts: Counts) -> None:
        self._client, self._counts = client, counts
        self._rates = Buckets(COMMANDS)
        self.outbox = Outbox(partial(counts.add, "commands_dropped"))
        """The server must exit when its thread is dead: no viewer can drive then, and no zero
        command is sent."""

    def give(
        self, owner: str, source: str, commander: Commander, sender: Sender, wish: Wish
    ) -> bool:
        """Queue a command in place of an older one of the same commander.

        Return False if its owner, a token or a local viewer, sends too many. A zero after a speed
        is queued in any case.
        """
        now_ns = clock.mono_ns()
        ends = wish.twist == REST and commander.drives(now_ns)
        if not self._rates.take(owner, now_ns) and not ends:
            return False
        replaced = commander.replaced
        self.outbox.take(commander, partial(self._put, source, sender), wish)
        if commander.replaced > replaced:
            self._counts.add("commands_superseded")
        return True

    def _put(self, source: str, sender: Sender, wish: Wish) -> None:
        try:
            client = self._client()
            if client is not None:
                twist = Twist(Vector3(x=wish.twist.linear), Vector3(z=wish.twist.angular))
                zero = wish.twist == REST
                signature = sender.sign(wish.stamp_ns, steady=wish.steady, zero=zero)
                client.put(twist, signature, source)
                self._counts.add("commands")
                return
        except Exception:  # noqa: BLE001, S110 - only this one command is lost
            pass
        self._counts.add("commands_dropped")
