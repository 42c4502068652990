"""A phone, simulated by a network namespace with its own address and a cable to the container."""

from __future__ import annotations

import os
import socket
import ssl
import subprocess
from contextlib import suppress

import aiohttp

from tests.system.hosts import inside, ip
from tests.systemd.container import Container, unavailable

ROBOT_AT, PHONE_AT = "192.168.77.1", "192.168.77.2"
"""An address on a network that `lan.conf` names."""

STRANGE, STRANGER_AT = "203.0.113.1", "203.0.113.2"
"""The addresses of robot and phone on a network that it does not name."""

CONNECT_S = 1.0
"""Time limit for a connection, because dropped packets get no answer."""


class Phone:
    """A network namespace. The end of the `with` removes it and its cable."""

    def __init__(self, container: Container) -> None:
        self._container = container
        self.name = f"acsard{os.getpid()}p"
        self.authority = container.path("/etc/acsard/tls/ca.pem")
        """The authority's certificate, which was copied to the phone."""

    def __enter__(self) -> Phone:
        try:
            ip("netns", "add", self.name)
            ip("-n", self.name, "link", "set", "lo", "up")
            cable = ("link", "add", "cable", "type", "veth", "peer", "name", "cable")
            ip("-n", self.name, *cable, "netns", str(self._container.leader))
            for at in (PHONE_AT, STRANGER_AT):
                ip("-n", self.name, "address", "add", f"{at}/24", "dev", "cable")
            ip("-n", self.name, "link", "set", "cable", "up")
        except subprocess.CalledProcessError as error:
            self.__exit__()
            unavailable(f"no network namespace: {error.stderr.decode()}")
        for at in (ROBOT_AT, STRANGE):
            self._container.types(f"ip address add {at}/24 dev cable")
        self._container.types("ip link set cable up")
        return self

    def __exit__(self, *error: object) -> None:
        ip("netns", "delete", self.name, check=False)

    def reaches(self, port: int, at: str = ROBOT_AT) -> bool:
        """Return whether a program on the phone can connect to this port and address."""
        with inside(self.name), suppress(OSError):
            socket.create_connection((at, port), CONNECT_S).close()
            return True
        return False

    def presented_certificate(self, port: int) -> str:
        """Return the certificate that the robot presents at this port, or "" if nothing answers.

        The connection fails unless our authority has signed the certificate.
        """
        with inside(self.name), suppress(OSError):
            return ssl.get_server_certificate(
                (ROBOT_AT, port), ca_certs=str(self.authority), timeout=CONNECT_S
            )
        return ""

    def browser(self, token: str = "") -> aiohttp.ClientSession:
        """Open an HTTP session that trusts the authority.

        It keeps cookies like a browser, or sends a token like a program. Open and use it `inside`
        the phone's namespace.
        """
        trusted = ssl.create_default_context(cafile=str(self.authority))
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        return aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(ssl=trusted),
            cookie_jar=aiohttp.CookieJar(unsafe=True),  # cookies of an address, not only of a name
            headers=headers,
        )
