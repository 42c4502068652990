"""The router of a fleet: makes its configuration file, and runs Zenoh as a router.

As with zenohd, the access rules in the file say what each client may do. Any client with a
certificate can still make a router hang with requests that the rules allow. This router detects
that it hangs, and restarts within 2 s (`listener_process.py`).

The template `deploy/zenoh/router.json5` is for one robot. `router_file` repeats the template's
lines between the marks ROBOT and END for each robot. It repeats the lines between PERSON
and END PERSON for each certificate that may command.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import zenoh

from acsard.bus.certificate_watch import CertificateFiles
from acsard.bus.zenoh_sessions import first_line
from acsard.core.values import ROLES, Role
from acsard.daemon.gateway.listener_process import Events, Listener, Observation
from acsard.host import clock
from acsard.host.errors import InUseError, RouterFileError, UsageError

EXAMPLE_ROBOT = "robot1"
"""Id of the example robot in `router.json5`, which is the template."""

ROBOTS_COMMENT = "// This file is for {}. To make a file for your own robots:\n"
"""Comment near the top of the template and of the router's file. The ids of the robots replace
{}."""

_BLOCK = re.compile(r"^ *// ROBOT\n(.*?)^ *// END\n", re.M | re.S)
_NAME = re.compile(rf"\b{EXAMPLE_ROBOT}\b")

EXAMPLE_OPERATOR: Role = "operator"
"""Example name in the template's lines between PERSON and END PERSON. The common name of each
certificate that may command replaces this name."""

_PERSONS = re.compile(r"^ *// PERSON\n(.*?)^ *// END PERSON\n", re.M | re.S)
# Match a whole name or the last part of a key, but not the beginning of a robot's id "operator-1".
_PERSON = re.compile(rf'(?<=[/" ]){EXAMPLE_OPERATOR}(?=")')


def router_file(template: str, robots: Sequence[str], people: Mapping[Role, Sequence[str]]) -> str:
    """Return the text of the router's configuration file.

    Raises `UsageError` if a name occurs twice, because a certificate belongs either to one robot or
    to one role.

    Args:
        template: the text of `deploy/zenoh/router.json5`.
        robots: the robots' ids.
        people: maps each role to the common names of the certificates with this role. The
            certificates "viewer", "operator" and "maintainer" always have the role of their name,
            so leave them out.
    """
    names = [*robots, *ROLES, *(name for role in ROLES for name in people.get(role, ()))]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(
            f"these names occur more than once: {', '.join(twice)}. Name each certificate once, "
            "either as a robot or in the list of one role. Leave out the names "
            f"{', '.join(ROLES)}: these certificates have their roles already"
        )
    text = _BLOCK.sub(
        lambda block: "".join(_with(_NAME, robot, block[1]) for robot in robots), template
    )
    text = text.replace(
        ROBOTS_COMMENT.format(EXAMPLE_ROBOT), ROBOTS_COMMENT.format(", ".join(robots))
    )
    for role in ROLES:
        listed = ", ".join(json.dumps(name) for name in (role, *people.get(role, ())))
        template_list = _SUBJECT.format(f"{role}s", f'"{role}"')
        text = text.replace(template_list, _SUBJECT.format(f"{role}s", listed))
    # The template has separate lines for the certificate "maintainer", which may command too.
    commanders = [EXAMPLE_OPERATOR, *people.get("operator", ()), *people.get("maintainer", ())]
    names = [json.dumps(name)[1:-1] for name in commanders]
    return _PERSONS.sub(
        lambda block: "".join(_with(_PERSON, name, block[1]) for name in names), text
    )


_SUBJECT = 'id: "{}", link_protocols: ["tls"], cert_common_names: [{}]'
"""Line of the template that lists the certificates of a role."""


def _with(pattern: re.Pattern[str], name: str, block: str) -> str:
    # The replacement is a function, because a name may look like a reference to a group.
    return pattern.sub(lambda _: name, block)


ROUTER_EVENTS: Events = {
    "open": "router_open",
    "full": "router_full",
    "stuck": "router_stuck",
    # "alone" is absent because the router needs no daemon.
}

CERTIFICATE_FILES = ("root_ca_certificate", "listen_certificate", "listen_private_key")
"""Names of the settings in Zenoh's `transport/link/tls` that name the certificate files of a
listening endpoint."""

ENDPOINT_ADDRESS = re.compile(r"^(tcp|tls|udp|quic|ws)/[^?#]*")
"""Matches the protocol and the address of an endpoint, without its settings."""

_VALUE_ERROR = re.compile(
    r'msg: "((?:[^"\\]|\\.)*)", location: Some\(Location \{ line: (\d+), column: (\d+) \}\)'
)
"""Matches Zenoh's error about a wrong key or value in a configuration."""

_SYNTAX_ERROR = re.compile(
    r"--> (\d+):(\d+)\n.*^ *= ([^\n]*?)(?: at /\S+\.rs:\d+\.?)?$", re.M | re.S
)
"""Matches Zenoh's error about text that is not JSON5."""


def reason(error: zenoh.ZError) -> str:
    """Return the readable part of Zenoh's error about a configuration file.

    If the error names a line and a column of the file, the result begins with them.
    """
    text = str(error)
    if match := _VALUE_ERROR.search(text):
        message = re.sub(r"\\(.)", r"\1", match[1])
        return f"line {match[2]}, column {match[3]}: {message}"
    if match := _SYNTAX_ERROR.search(text):
        return f"line {match[1]}, column {match[2]}: {match[3]}"
    return first_line(error)


class Router(Listener):
    """The router of a fleet. It reads a configuration file for zenohd, and runs without plugins."""

    events = ROUTER_EVENTS

    def __init__(self, file: Path) -> None:
        """Read the router's configuration file `file`.

        Raises `RouterFileError` if the file cannot be read or is not a router's configuration.
        """
        self._file = file
        try:
            # Read the file here, because Zenoh's error would not say why the file cannot be opened.
            file.read_bytes()
        except OSError as error:
            raise RouterFileError(
                f"cannot read {file}: {error.strerror}; name a file that this user may read"
            ) from None
        try:
            self._config = zenoh.Config.from_file(str(file))
            mode, endpoints = self._setting("mode"), self._setting("listen/endpoints")
            self.most = int(self._setting("transport/unicast/max_sessions"))
            self._config.insert_json5("plugins_loading/enabled", "false")
        except zenoh.ZError as error:
            raise RouterFileError(
                f"{file} is not a Zenoh configuration: {reason(error)}; correct it"
            ) from error
        # A file without endpoints gets Zenoh's default, a dict: every address, without encryption.
        if isinstance(endpoints, dict):
            endpoints = []
        if mode != "router" or not endpoints:
            raise RouterFileError(
                f'{file} is not the configuration of a router: it needs mode: "router" and '
                'listen: { endpoints: ["tls/..."] }'
            )
        self._endpoints: list[str] = endpoints
        self.files = self._certificate_files()
        self.where = ", ".join(endpoints)

    def open(self) -> zenoh.Session:
        """Open the router's session and listen.

        Raises `InUseError` if an address is in use, or is not an address of this machine. Raises
        `RouterFileError` if the file must be corrected.
        """
        try:
            return zenoh.open(self._config)
        except zenoh.ZError as error:
            if not self._opens_elsewhere():
                raise RouterFileError(
                    f"{self._file} cannot be used: {reason(error)}; correct it, and make "
                    "sure that this user can read the files that it names"
                ) from error
            raise InUseError(
                f"cannot listen on {self.where}: {reason(error)}; end the program that uses the "
                "address, or write addresses of this machine into listen: { endpoints: [...] } of "
                "the router's file"
            ) from error

    def _opens_elsewhere(self) -> bool:
        """Return whether Zenoh accepts the file with other addresses: free ports on loopback.

        If it does, only the addresses in the file are wrong. Zenoh's own error does not show this.
        """
        config = zenoh.Config.from_file(str(self._file))
        free = [ENDPOINT_ADDRESS.sub(r"\1/127.0.0.1:0", endpoint) for endpoint in self._endpoints]
        config.insert_json5("listen/endpoints", json.dumps(free))
        config.insert_json5("connect/endpoints", "[]")
        config.insert_json5("plugins_loading/enabled", "false")
        try:
            zenoh.open(config).close()
        except zenoh.ZError:
            return False
        return True

    def _setting(self, key: str) -> Any:
        return json.loads(self._config.get_json(key))

    def _certificate_files(self) -> CertificateFiles | None:
        tls = self._setting("transport/link/tls") or {}
        named = [Path(tls[name]) for name in CERTIFICATE_FILES if tls.get(name)]
        return CertificateFiles(*named) if len(named) == len(CERTIFICATE_FILES) else None

    def observe(self, session: zenoh.Session) -> Observation:
        holders = tuple(link.auth_identifier or "" for link in session.info.links())
        return Observation(clock.mono_ns(), holders, linked=True)
