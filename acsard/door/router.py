"""A fleet's router: Zenoh in router mode by a configuration of Zenoh's own, watched (`watched.py`).

The rules in the file say who may do what, as they do for zenohd. Beyond those anybody with a
certificate can hold up a router; this one notices, and opens anew within 2 s.
"""

from __future__ import annotations

import json
from pathlib import Path

import zenoh

from acsard.bus.session import first_line
from acsard.door.watch import Look, Watch
from acsard.host import clock
from acsard.host.errors import InUseError, UsageError


class Router:
    """What zenohd would open, without its plugins."""

    def __init__(self, file: Path) -> None:
        """Raises `UsageError` for a file that Zenoh does not take."""
        try:
            self._config = zenoh.Config.from_file(str(file))
            mode = json.loads(self._config.get_json("mode"))
            endpoints = json.loads(self._config.get_json("listen/endpoints"))
            self.most = int(json.loads(self._config.get_json("transport/unicast/max_sessions")))
            self._config.insert_json5("plugins_loading/enabled", "false")
        except zenoh.ZError as error:
            raise UsageError(f"{file}: {first_line(error)}") from error
        if isinstance(endpoints, dict):  # by mode, as Zenoh has it of itself: everywhere, in clear
            endpoints = []
        if mode != "router" or not endpoints:
            raise UsageError(
                f'{file}: not a router\'s; it needs mode: "router" and listen: {{ endpoints: '
                '["tls/..."] }'
            )
        self.where = ", ".join(endpoints)

    def ready(self) -> bool:
        """A router waits for nobody."""
        return True

    def open(self) -> zenoh.Session:
        """Listen; raises `InUseError`."""
        try:
            return zenoh.open(self._config)
        except zenoh.ZError as error:
            raise InUseError(
                f"cannot listen on {self.where}: {first_line(error)}; are the addresses free, and "
                "the files of transport/link/tls there and ours to read?"
            ) from error

    def look(self, session: zenoh.Session) -> Look:
        """Who is connected: all come from outside, and nobody is waited for."""
        links = session.info.links()
        return Look(clock.mono_ns(), tuple(link.auth_identifier or "" for link in links), True)

    def tell(self, session: zenoh.Session, look: Look, watch: Watch) -> None:
        """It concerns nobody but the log."""
