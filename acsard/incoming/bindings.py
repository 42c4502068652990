"""Binds each sender id to the certificate under which the daemon first saw it.

The certificate is part of a sender's name (`messages/signature.py`), so a command under another
certificate counts as another sender's in any case. But one id under two certificates is a mistake
or a stolen secret. The daemon therefore refuses the second one for as long as the first one speaks.

Only native keys name a certificate. A sender that commands on a key of ROS is bound to nothing, and
its name is never that of a native sender.
"""

from __future__ import annotations

from acsard.values import NS_PER_S

BOUND_NS = 60 * NS_PER_S
"""A sender that is silent for longer may come back under another certificate, for example when a
program with a fixed id moves from the robot to a laptop."""

MAX_BOUND = 1024
"""Senders remembered at once. The one that was seen longest ago is forgotten first."""


class Bindings:
    """The certificates of the senders that were seen lately."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[str, int]] = {}
        """Certificate, "" for the robot's own machine, and time of the last command, by sender."""

    def other(self, sender: str, certificate: str, now_ns: int) -> str | None:
        """Return the certificate that the sender is bound to, or None if it is this one."""
        bound, seen_ns = self._seen.get(sender, (certificate, now_ns))
        if bound != certificate and now_ns - seen_ns <= BOUND_NS:
            return bound
        self._seen.pop(sender, None)
        self._seen[sender] = (certificate, now_ns)
        if len(self._seen) > MAX_BOUND:
            del self._seen[next(iter(self._seen))]
        return None
