"""Finds out which role this client has at a robot, and which certificate the client uses.

Zenoh does not tell the daemon over which link a query came. So each role has a key, and the access
rules let a client query those of its own role and lower ones: the highest that answers is its role.
The certificate's name comes from the client's own file.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Literal

import zenoh
from msgspec import Struct

from acsard.bus.tls_files import common_name
from acsard.core.messages.keys_and_roles import full_key, whoami_key
from acsard.core.messages.permissions import ROLE_TEXTS, has, least_role
from acsard.core.values import NS_PER_S, ROLES, Role
from acsard.host import clock

WHOAMI_S, WHOAMI_MORE_S = 2.0, 0.3  # for the first answer, and then for further ones

# Queries a key, and calls the callback with each sample of the reply.
Ask = Callable[[str, Callable[[zenoh.Sample], object]], None]


class ClientIdentity(Struct, frozen=True):
    role: Role | Literal[""]  # "" if no query was answered
    certificate: str  # common name, if there is one
    sender: str  # as the daemon names it
    robot: str = ""
    endpoint: str = ""

    def lacks(self, key: str) -> str:
        """Return why this client may not use a key (without the robot's id), or "".

        If the role is unknown, return likely reasons for the silence, or "" without a certificate.
        """
        if not self.role:
            return self.silence
        try:
            least = least_role(key)
        except LookupError:
            # The key is the reason, not the role.
            return ""
        if has(self.role, least):
            return ""
        return f"{self.describe()}; {key} needs at least the role {least}"

    @property
    def silence(self) -> str:
        """Likely reasons why the robot answered no query; "" if it did, or without a certificate.

        A client cannot tell whether the robot is absent, hangs, or does not list the certificate.
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
        """Return a sentence about role and certificate, or about the silence."""
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
    """Query the robot for this client's role, for at most `WHOAMI_S`."""
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
