"""A router for a fleet: Zenoh in router mode with a Zenoh configuration file, supervised.

As with zenohd, the rules in the file are the permissions of the clients. Within these rules, any
client with a certificate can still block a router. This one detects it and restarts within 2 s
(`supervision.py`).
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import zenoh

from acsard.bus.session import first_line
from acsard.door.watch import Events, Look, Watch
from acsard.host import clock
from acsard.host.errors import InUseError, RouterFileError

ROUTER_EVENTS: Events = {
    "open": "router_open",
    "crowded": "router_crowded",
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
                f"{file} is no configuration of Zenoh's: {why(error)}; correct it"
            ) from error
        # Zenoh's default is a table by mode: every address, without encryption.
        if isinstance(endpoints, dict):
            endpoints = []
        if mode != "router" or not endpoints:
            raise RouterFileError(
                f'{file}: not a router\'s; it needs mode: "router" and listen: {{ endpoints: '
                '["tls/..."] }'
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
                    f"{self._file} cannot be used: {why(error)}; correct it, or put the files it "
                    "names in place, ours to read"
                ) from error
            raise InUseError(
                f"cannot listen on {self.where}: {why(error)}; are the addresses free, and of "
                "this machine?"
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
