"""A router for a fleet: writes its Zenoh configuration file, and runs Zenoh in router mode with it.

As with zenohd, the rules in the file are the permissions of the clients. Within these rules, any
client with a certificate can still block a router. This one detects it and restarts within 2 s
(`supervision.py`).

The file is made of `deploy/zenoh/router.json5`, which is for one robot, and edited as text. The
lines between the marks ROBOT and END are repeated for each robot. Those between PERSON and END
PERSON are repeated for each certificate that may command.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import zenoh

from acsard.core.values import ROLES, Role
from acsard.daemon.bus.zenoh_sessions import first_line
from acsard.daemon.gateway.watch import Events, Look, Watch
from acsard.host import clock
from acsard.host.errors import InUseError, RouterFileError, UsageError

EXAMPLE = "robot1"
"""Id of the robot in the template."""

IS_FOR = "// It is for {}. For yours:\n"
"""Line at the head of the template."""

_BLOCK = re.compile(r"^ *// ROBOT\n(.*?)^ *// END\n", re.M | re.S)
_NAME = re.compile(rf"\b{EXAMPLE}\b")

PERSON: Role = "operator"
"""Common name in the template's lines for a person."""

_PERSONS = re.compile(r"^ *// PERSON\n(.*?)^ *// END PERSON\n", re.M | re.S)
# Match a whole name, or the last part of a key, because a robot may be called operator-1.
_PERSON = re.compile(rf'(?<=[/" ]){PERSON}(?=")')


def router_file(template: str, robots: Sequence[str], people: Mapping[Role, Sequence[str]]) -> str:
    """Return the configuration for these robots and for the further certificates of people.

    `people` maps a role to the common names of further certificates. Raises `UsageError` for a name
    that occurs twice, because a certificate belongs to one robot or to one role.
    """
    names = [*robots, *ROLES, *(name for role in ROLES for name in people.get(role, ()))]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(
            f"{', '.join(twice)}: named twice; a certificate belongs to one robot, or to the "
            f"list of one role, and {', '.join(ROLES)} are in their own lists"
        )
    # The replacement is a function, since an id or a name may look like a reference to a group.
    text = _BLOCK.sub(lambda block: "".join(_for(one, block[1]) for one in robots), template)
    text = text.replace(IS_FOR.format(EXAMPLE), IS_FOR.format(", ".join(robots)))
    for role in ROLES:
        listed = ", ".join(json.dumps(name) for name in (role, *people.get(role, ())))
        alone = _SUBJECT.format(f"{role}s", f'"{role}"')
        text = text.replace(alone, _SUBJECT.format(f"{role}s", listed))
    # The template has lines for the certificate "maintainer" as well as for "operator".
    drivers = [PERSON, *people.get("operator", ()), *people.get("maintainer", ())]
    return _PERSONS.sub(lambda block: "".join(_by(one, block[1]) for one in drivers), text)


_SUBJECT = 'id: "{}", link_protocols: ["tls"], cert_common_names: [{}]'


def _by(person: str, block: str) -> str:
    return _PERSON.sub(lambda _: json.dumps(person)[1:-1], block)


def _for(robot: str, block: str) -> str:
    return _NAME.sub(lambda _: robot, block)


ROUTER_EVENTS: Events = {
    "open": "router_open",
    "full": "router_full",
    "stuck": "router_stuck",
    # "alone" is missing because the router does not wait for a daemon.
}

AN_ADDRESS = re.compile(r"^(tcp|tls|udp|quic|ws)/[^?#]*")
"""Part of an endpoint that may be in use or not exist yet."""

_KNOWN = re.compile(
    r'msg: "((?:[^"\\]|\\.)*)", location: Some\(Location \{ line: (\d+), column: (\d+) \}\)'
)
_GRAMMAR = re.compile(r"--> (\d+):(\d+)\n.*^ *= ([^\n]*?)(?: at /\S+\.rs:\d+\.?)?$", re.M | re.S)


def why(error: zenoh.ZError) -> str:
    """Return Zenoh's complete message about an invalid configuration, with the position."""
    text = str(error)
    if match := _KNOWN.search(text):
        message = re.sub(r"\\(.)", r"\1", match[1])
        return f"line {match[2]}, column {match[3]}: {message}"
    if match := _GRAMMAR.search(text):
        return f"line {match[1]}, column {match[2]}: {match[3]}"
    return first_line(error)


class Router:
    """The router that zenohd would open, without its plugins."""

    events = ROUTER_EVENTS

    def __init__(self, file: Path) -> None:
        """Read the file; raise `RouterFileError` if Zenoh does not accept it."""
        self._file = file
        try:
            # Zenoh reports only that it could not open the file.
            file.read_bytes()
        except OSError as error:
            raise RouterFileError(f"cannot read {file}: {error.strerror}; correct it") from None
        try:
            self._config = zenoh.Config.from_file(str(file))
            mode = json.loads(self._config.get_json("mode"))
            endpoints = json.loads(self._config.get_json("listen/endpoints"))
            self.most = int(json.loads(self._config.get_json("transport/unicast/max_sessions")))
            self._config.insert_json5("plugins_loading/enabled", "false")
        except zenoh.ZError as error:
            raise RouterFileError(
                f"{file} is not a Zenoh configuration: {why(error)}; correct it"
            ) from error
        # Zenoh's default is a table by mode: every address, without encryption.
        if isinstance(endpoints, dict):
            endpoints = []
        if mode != "router" or not endpoints:
            raise RouterFileError(
                f'{file} is not the configuration of a router: it needs mode: "router" and '
                'listen: { endpoints: ["tls/..."] }'
            )
        self._endpoints: list[str] = endpoints
        self.where = ", ".join(endpoints)

    def ready(self) -> bool:
        """Return True: a router does not wait for a daemon."""
        return True

    def open(self) -> zenoh.Session:
        """Listen; raise `InUseError` if that may be possible later, else `RouterFileError`."""
        try:
            return zenoh.open(self._config)
        except zenoh.ZError as error:
            if not self._opens_elsewhere():
                raise RouterFileError(
                    f"{self._file} cannot be used: {why(error)}; correct it, or provide the "
                    "files that it names, readable for this user"
                ) from error
            raise InUseError(
                f"cannot listen on {self.where}: {why(error)}; are the addresses free, and do "
                "they belong to this machine?"
            ) from error

    def _opens_elsewhere(self) -> bool:
        """Return whether the configuration opens on free addresses of this machine.

        If it does, only its own addresses are at fault, and they may become free later. Zenoh's
        messages do not tell this case from a mistake in the file.
        """
        config = zenoh.Config.from_file(str(self._file))
        free = [AN_ADDRESS.sub(r"\1/127.0.0.1:0", endpoint) for endpoint in self._endpoints]
        config.insert_json5("listen/endpoints", json.dumps(free))
        config.insert_json5("connect/endpoints", "[]")
        config.insert_json5("plugins_loading/enabled", "false")
        try:
            zenoh.open(config).close()
        except zenoh.ZError:
            return False
        return True

    def look(self, session: zenoh.Session) -> Look:
        """Return the connections. All come from outside, and no daemon is awaited."""
        links = session.info.links()
        return Look(clock.mono_ns(), tuple(link.auth_identifier or "" for link in links), True)

    def tell(self, session: zenoh.Session, look: Look, watch: Watch) -> None:
        """Do nothing: the log has all reports of a router."""
