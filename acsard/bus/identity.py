"""Who we are to a daemon: the role by what it answers, the certificate by what we show.

Zenoh tells a daemon nothing of the link that a question came by. But the access rules let each role
ask for its own key and those below it, so that the highest that answers is the role.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Literal

import zenoh
from msgspec import Struct

from acsard.bus.access import MAY, least_role
from acsard.bus.certificates import common_name
from acsard.host import clock
from acsard.messages.topics import full_key, whoami_key
from acsard.values import NS_PER_S, ROLES, Role

WHOAMI_S, WHOAMI_MORE_S = 2.0, 0.3
"""For the first answer, and for those that come with it."""

Ask = Callable[[str, Callable[[zenoh.Sample], object]], None]
"""Asks a key and calls back with what it answers, if it does."""


class Identity(Struct, frozen=True):
    """Who a client is to the daemon."""

    role: Role | Literal[""]
    """What its link lets it do; "" when it may not even ask, or the daemon does not tell."""
    certificate: str
    """The name in its certificate, "" without one."""
    sender: str
    """Its name on each command."""
    robot: str = ""
    """The id that was asked for."""
    endpoint: str = ""
    """Where."""

    def lacks(self, key: str) -> str:
        """Why one may not use a key below the robot's id, "" when that is not known."""
        least = least_role(key)
        if not self.role:
            return self.silence
        if ROLES.index(self.role) >= ROLES.index(least):
            return ""
        return f"{self.words()}; {key} is for a certificate that is {least}"

    @property
    def silence(self) -> str:
        """Why nobody answers us, the likeliest first; "" with a role, or without a certificate.

        From here the silence of a robot that is not there, one that is stuck, and one that does
        not know our certificate are the same: none of them is claimed.
        """
        return "" if self.role or not self.certificate else self._nobody()

    def _nobody(self) -> str:
        where = f" at {self.endpoint}" if self.endpoint else ""
        asked = full_key(self.robot, whoami_key(ROLES[0])) if self.robot else ""
        who = f" as '{self.robot}'{where} (asked: {asked})" if asked else where
        told = f"nobody answers{who}: is --id right, and does that robot's daemon run, unstuck?"
        if not self.certificate:
            return told
        return (
            f"{told} If so: a certificate in no role's list ([access] in the robot's acsard.toml; "
            f"behind a router the router's) gets no answer either; yours is {self.certificate}"
        )

    def words(self) -> str:
        """Role and certificate in a sentence."""
        if self.role:
            whose = f"your certificate {self.certificate}" if self.certificate else "you, without"
            whose += "" if self.certificate else " a certificate here, by this link"
            return f"{whose} is {self.role}: {MAY[self.role]}"
        return self._nobody()


def identity(ask: Ask, tls: str, sender: str, robot: str = "", endpoint: str = "") -> Identity:
    """Ask this robot, there, who we are; `tls` is our certificate's directory, "" for none."""
    answers: SimpleQueue[str] = SimpleQueue()
    for one in ROLES:
        ask(whoami_key(one), lambda sample: answers.put(str(sample.key_expr)))
    best, end = -1, _now_s() + WHOAMI_S
    while best < len(ROLES) - 1 and (left := end - _now_s()) > 0:
        with suppress(Empty):
            role = answers.get(timeout=left).rpartition("/")[2]
            # What one may not ask gets no answer: the others come at the same time, or never.
            end = min(end, _now_s() + WHOAMI_MORE_S)
            best = max(best, next((n for n, r in enumerate(ROLES) if r == role), -1))
    name = common_name(tls) if tls else ""
    return Identity(ROLES[best] if best >= 0 else "", name, sender, robot, endpoint)


def _now_s() -> float:
    return clock.mono_ns() / NS_PER_S
