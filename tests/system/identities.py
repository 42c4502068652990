"""Provides the identities of clients on the bus.

They are plain clients, clients with a certificate of each role, and clients with a bad one.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import zenoh

from acsard.machine.authority import Authority
from tests.system.harness import (
    Daemon,
    Finished,
    Tables,
    acsard,
    client_config,
    finish,
    free_endpoint,
)

Identity = Literal[
    "local", "viewer", "operator", "maintainer", "unlisted", "nobody", "foreign", "expired"
]

ADMITTED: tuple[Identity, ...] = ("local", "viewer", "operator", "maintainer")
"""Plain TCP on this machine, and the certificates that `acsard tls init` makes."""


class Certificates:
    """The certificates of one robot and of unauthorised clients, below a directory."""

    def __init__(self, where: Path, *addresses: str) -> None:
        self.robot = where / "tls"
        reached = [word for address in addresses for word in ("--address", address)]
        self._run_tls("init", "--directory", str(self.robot), *reached)
        self._run_tls(
            "add", "unlisted", "--role", "operator", "--directory", str(self.robot)
        )  # the lines it prints are not written to the configuration
        self._run_tls("init", "--directory", str(where / "another"))
        self._client: dict[Identity, Path] = {
            role: self.robot / "clients" / role
            for role in ("viewer", "operator", "maintainer", "unlisted")
        }
        self._client["foreign"] = where / "another" / "clients" / "operator"
        self._client["expired"] = where / "expired"
        self.issue(self._client["expired"], "operator", -1.0)

    @staticmethod
    def _run_tls(*words: str) -> None:
        done = finish(acsard("tls", *words), "/")
        assert done.code == 0, done

    def issue(self, directory: Path, name: str, days: float) -> None:
        """Issue one more certificate by this robot's authority."""
        Authority.load(self.robot).issue(directory, name, [], days)

    def config(self, identity: Identity, plain: str, tls: str) -> zenoh.Config:
        """Return the Zenoh settings of a client with this identity.

        Each client trusts the robot's CA.
        """
        if identity == "local":
            return client_config(plain)
        return self.client_settings(tls, self.own(identity))

    def own(self, identity: Identity) -> Path | None:
        """Return the directory of the identity's certificate."""
        return self._client.get(identity)

    def client_settings(self, endpoint: str, own: Path | None) -> zenoh.Config:
        """Return the Zenoh settings of a client that presents the certificate in `own`, if any."""
        config = client_config(endpoint)
        config.insert_json5("transport/link/tls", json.dumps(self.settings(own)))
        return config

    def settings(self, own: Path | None) -> dict[str, object]:
        """Return `transport/link/tls` of a client with the certificate in `own`, if any."""
        tls: dict[str, object] = {"root_ca_certificate": str(self.robot / "ca.pem")}
        if own is not None:
            tls["enable_mtls"] = True
            tls["connect_certificate"] = str(own / "certificate.pem")
            tls["connect_private_key"] = str(own / "key.pem")
        return tls


def free_tls_endpoint() -> str:
    """Return a loopback address for TLS on which no program listens."""
    return free_endpoint().replace("tcp/", "tls/")


class Gated:
    """A daemon with a plain and a TLS endpoint, and clients that come to either."""

    def __init__(self, where: Path, certificates: Certificates | None = None, **more: Any) -> None:
        self.certificates = certificates or Certificates(where)
        self.plain, self.tls = free_endpoint(), free_tls_endpoint()
        bus = {"listen": [self.plain, self.tls], "tls": str(self.certificates.robot)}
        tables: Tables = {"bus": bus} | more
        self.daemon = Daemon(where, config=tables, endpoint=self.plain)

    def own(self, identity: Identity) -> str:
        return str(self.certificates.own(identity))

    def opened(self, identity: Identity) -> zenoh.Session:
        """Open a session with this identity."""
        return zenoh.open(self.certificates.config(identity, self.plain, self.tls))

    def lets_in(self, identity: Identity) -> bool:
        """Return whether a new session with this identity gets an answer."""
        try:
            with self.opened(identity) as session:
                return any(r.ok for r in session.get("acsard/acsar/state", timeout=1.0))
        except zenoh.ZError:
            return False

    def tool(self, who: Identity, *words: str) -> Finished:
        link = ("--connect", self.tls, "--tls", self.own(who))
        ended = finish(acsard(*words, *link), self.daemon.config.parent)
        assert "Traceback" not in ended.err, ended.err
        return ended
