"""Finds out a client's identity: its role by the keys that answer, its certificate by its own file.

Zenoh does not tell the daemon which link a query came by. But the access rules let each role query
only its own key and those of lower roles, so the highest key that answers is the role.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Literal

import zenoh
from msgspec import Struct

from acsard.core.messages.permissions import MAY, has, least_role
from acsard.core.messages.topics import full_key, whoami_key
from acsard.core.values import NS_PER_S, ROLES, Role
from acsard.daemon.bus.tls import common_name
from acsard.host import clock

WHOAMI_S, WHOAMI_MORE_S = 2.0, 0.3
"""Seconds to wait for the first answer, and for more answers once one has come."""

Ask = Callable[[str, Callable[[zenoh.Sample], object]], None]
"""A function that queries a key and calls back with each sample that answers."""


class Identity(Struct, frozen=True):
    """The identity of a client as the daemon sees it."""

    role: Role | Literal[""]
    """The role of the client's link, "" if no key answered."""
    certificate: str
    """The common name of the client's certificate, "" without one."""
    sender: str
    """The client's name on each command."""
    robot: str = ""
    """The id of the robot that was queried."""
    endpoint: str = ""
    """The endpoint of the query."""

    def lacks(self, key: str) -> str:
        """Return why this client may not use a key below the robot's id.

        "" means that it may, or that neither its role nor its certificate is known.
        """
        least = least_role(key)
        if not self.role:
            return self.silence
        if has(self.role, least):
            return ""
        return f"{self.words()}; {key} is for a certificate that is {least}"

    @property
    def silence(self) -> str:
        """The likeliest reasons why no key answered, "" with a role or without a certificate.

        A client cannot distinguish a robot that is absent, one that is stuck and one that does not
        list the client's certificate. The message therefore asserts none of the three.
        """
        return "" if self.role or not self.certificate else self._nobody()

    def _nobody(self) -> str:
        where = f" at {self.endpoint}" if self.endpoint else ""
        asked = full_key(self.robot, whoami_key(ROLES[0])) if self.robot else ""
        who = f" as '{self.robot}'{where} (asked: {asked})" if asked else where
        told = (
            f"no daemon answers{who}: is --id right, and does that robot's daemon run and answer?"
        )
        if not self.certificate:
            return told
        return (
            f"{told} If so, your certificate, {self.certificate}, may be missing from every "
            "role's list ([access] in the robot's acsard.toml; behind a router, the router's "
            "list). The robot answers only certificates in a list"
        )

    def words(self) -> str:
        """Return the role and the certificate in a sentence."""
        if self.role:
            whose = f"your certificate {self.certificate}" if self.certificate else "you, without"
            whose += "" if self.certificate else " a certificate that is valid here, over this link"
            return f"{whose} is {self.role}: {MAY[self.role]}"
        return self._nobody()


def identity(ask: Ask, tls: str, sender: str, robot: str = "", endpoint: str = "") -> Identity:
    """Query the robot for this client's role; return its identity.

    Blocks for up to WHOAMI_S. `tls` is the directory of the client's certificate, "" for none.
    """
    answers: SimpleQueue[str] = SimpleQueue()
    for one in ROLES:
        ask(whoami_key(one), lambda sample: answers.put(str(sample.key_expr)))
    best, end = -1, _now_s() + WHOAMI_S
    while best < len(ROLES) - 1 and (left := end - _now_s()) > 0:
        with suppress(Empty):
            role = answers.get(timeout=left).rpartition("/")[2]
            # A key that this client may not query never answers. The other answers arrive together.
            end = min(end, _now_s() + WHOAMI_MORE_S)
            best = max(best, next((n for n, r in enumerate(ROLES) if r == role), -1))
    name = common_name(tls) if tls else ""
    return Identity(ROLES[best] if best >= 0 else "", name, sender, robot, endpoint)


def _now_s() -> float:
    return clock.mono_ns() / NS_PER_S
