"""Finds out which role this client has at a robot, and which certificate the client uses.

Zenoh does not tell the daemon over which link a query came. Therefore, each role has a key, and the
access rules let a client query only the keys of its own role and of lower roles. The client queries
the keys of all roles. Its role is the highest one whose query is answered. The certificate's name
comes from the client's own file.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Literal

import zenoh
from msgspec import Struct

from acsard.bus.tls import common_name
from acsard.core.messages.keys_and_roles import full_key, whoami_key
from acsard.core.messages.permissions import ROLE_TEXTS, has, least_role
from acsard.core.values import NS_PER_S, ROLES, Role
from acsard.host import clock

WHOAMI_S, WHOAMI_MORE_S = 2.0, 0.3
"""`WHOAMI_S` is the longest wait for the first answer to the queries for the role, s. After that
answer, the client waits `WHOAMI_MORE_S` for further answers, s."""

Ask = Callable[[str, Callable[[zenoh.Sample], object]], None]
"""Function that queries a key of the robot. It calls the callback with each sample of the reply."""


class ClientIdentity(Struct, frozen=True):
    """The identity of a client at a robot: its role, its certificate and its name."""

    role: Role | Literal[""]
    """The role of the client; "" if the robot answered none of the queries for the role."""
    certificate: str
    """The common name of the client's certificate; "" if the client has no certificate."""
    sender: str
    """The name that the daemon gives to this client as a sender of commands."""
    robot: str = ""
    endpoint: str = ""

    def lacks(self, key: str) -> str:
        """Return the reason, in words, why this client may not use a Zenoh key of the robot.

        Return "" if the client may use the key. If the role is unknown, because the robot answered
        no query for it, return the likely reasons for the robot's silence. For a client without a
        certificate, return "" in this case.

        Args:
            key: the part of the Zenoh key after the robot's id, such as `state`.
        """
        least = least_role(key)
        if not self.role:
            return self.silence
        if has(self.role, least):
            return ""
        return f"{self.describe()}; {key} needs at least the role {least}"

    @property
    def silence(self) -> str:
        """Likely reasons why the robot answered no query for the client's role, in words.

        The text names several reasons, because a client cannot tell whether the robot is absent,
        hangs, or does not list the client's certificate. The text is "" if the robot answered a
        query, or if the client connects without a certificate.
        """
        return "" if self.role or not self.certificate else self._nobody()

    def _nobody(self) -> str:
        where = f" at {self.endpoint}" if self.endpoint else ""
        key = full_key(self.robot, whoami_key(ROLES[0])) if self.robot else ""
        robot = f" as '{self.robot}'{where} (queried key: {key})" if key else where
        message = (
            f"no daemon answers{robot}: is --id right, and is that robot's daemon running and not "
            "stuck?"
        )
        if not self.certificate:
            return message
        return (
            f"{message} If the daemon runs, your certificate, {self.certificate}, may be missing "
            "from every role's list. The lists are in [access] of the robot's acsard.toml; behind "
            "a router, they are in the router's file. The robot answers only certificates in a list"
        )

    def describe(self) -> str:
        """Return a sentence about the client's role and certificate.

        If the role is unknown, the text says instead why the robot may not have answered.
        """
        if not self.role:
            return self._nobody()
        owner = (
            f"your certificate {self.certificate} has the role"
            if self.certificate
            else "you connect without a certificate and have the role"
        )
        return f"{owner} {self.role}: {ROLE_TEXTS[self.role]}"


def identity(
    ask: Ask, tls: str, sender: str, robot: str = "", endpoint: str = ""
) -> ClientIdentity:
    """Query the robot for this client's role, and return the client's identity.

    Blocks for up to `WHOAMI_S`. `tls` is the directory of the client's certificate, or "" without a
    certificate. The other arguments, except `ask`, become fields of the result.
    """
    answers: SimpleQueue[str] = SimpleQueue()
    for role in ROLES:
        ask(whoami_key(role), lambda sample: answers.put(str(sample.key_expr)))
    best, end = -1, _now_s() + WHOAMI_S
    while best < len(ROLES) - 1 and (left := end - _now_s()) > 0:
        with suppress(Empty):
            name = answers.get(timeout=left).rpartition("/")[2]
            # The keys of roles above the client's own never answer, and all other answers arrive
            # at about the same time. So wait only a little longer after the first answer.
            end = min(end, _now_s() + WHOAMI_MORE_S)
            best = max(best, next((n for n, role in enumerate(ROLES) if role == name), -1))
    certificate = common_name(tls) if tls else ""
    return ClientIdentity(ROLES[best] if best >= 0 else "", certificate, sender, robot, endpoint)


def _now_s() -> float:
    return clock.mono_ns() / NS_PER_S
