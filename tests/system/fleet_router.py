"""Run the router of deploy/zenoh/router.json5 by the Zenoh library of Python, or by acsard."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zenoh

from acsard.machine.authority import Authority
from acsard.machine.router_file import router_file
from tests.system.harness import (
    ROOT,
    Answered,
    Bus,
    Daemon,
    Program,
    acsard,
    client_config,
    until,
)
from tests.system.identities import free_tls_endpoint
from tests.system.strangers import command_line

FILES = ROOT / "deploy" / "zenoh"
ROUTER_FILE, ROBOT_FILE = FILES / "router.json5", FILES / "robot.toml"

ROBOTS = ("robot1", "robot2")

ITS_NAME = "router.local"

_ROUTER = """\
import json, sys, time
import zenoh

config = zenoh.Config.from_file(sys.argv[1])
for key, value in json.loads(sys.argv[2]).items():
    config.insert_json5(key, json.dumps(value))
storages = json.loads(config.get_json("plugins/storage_manager/storages"))
last = {}

def keep(sample):
    last[str(sample.key_expr)] = sample

def answer(query):
    for key, sample in list(last.items()):
        if query.key_expr.intersects(zenoh.KeyExpr(key)):
            query.reply(
                key, sample.payload, encoding=sample.encoding, timestamp=sample.timestamp
            )

session = zenoh.open(config)
kept = [
    declare(storage["key_expr"], act)
    for storage in storages.values()
    for declare, act in ((session.declare_subscriber, keep), (session.declare_queryable, answer))
]
print("routing", flush=True)
time.sleep(600)
"""
"""A router with a configuration and changes to it. It loads no plugins, and acts like the storages.
"""


def certified(where: Path, *names: str) -> None:
    """Make a fleet's authority below `where`, and a directory with a certificate for each name."""
    authority = Authority.make(where, "fleet", 1)
    for name in names:
        authority.issue(where / name, name, ["127.0.0.1"], 1.0)


def tls_settings(own: Path) -> dict[str, object]:
    """Return the Zenoh setting `transport/link/tls` of a client. `own` has its certificate."""
    return {
        "root_ca_certificate": str(own / "ca.pem"),
        "connect_certificate": str(own / "certificate.pem"),
        "connect_private_key": str(own / "key.pem"),
        "enable_mtls": True,
    }


def secured_config(endpoint: str, own: Path) -> zenoh.Config:
    """Return the manual's settings for all languages, with the certificate in `own`."""
    config = client_config(endpoint)
    config.insert_json5("transport/link/tls", json.dumps(tls_settings(own)))
    return config


def file_for(where: Path, robots: Sequence[str] = ROBOTS) -> Path:
    """Write the router file for these robots, as `acsard tls router` creates it."""
    file = where / "router.json5"
    file.write_text(router_file(ROUTER_FILE.read_text(), robots, {}))
    return file


def _changes(file: Path, where: Path, endpoint: str) -> dict[str, object]:
    """Return the settings that a test changes in a router's file: address, files, no plugins."""
    config = zenoh.Config.from_file(str(file))
    tls = json.loads(config.get_json("transport/link/tls"))
    for key, value in tls.items():
        if isinstance(value, str):
            tls[key] = str(where / ITS_NAME / Path(value).name)
    return {
        "listen/endpoints": [endpoint],
        "transport/link/tls": {key: value for key, value in tls.items() if value is not None},
        "plugins_loading/enabled": False,
    }


def write_local_copy(file: Path, where: Path, endpoint: str) -> Path:
    """Write a copy of a router's file with this address, these certificates and no plugins."""
    config = zenoh.Config.from_file(str(file))
    for key, value in _changes(file, where, endpoint).items():
        config.insert_json5(key, json.dumps(value))
    changed = file.with_suffix(".json")
    changed.write_text(str(config))
    return changed


def robot_at(endpoint: str, where: Path, robot_id: str, mode: str = "client", **how: Any) -> Daemon:
    """Return a daemon with robot.toml and the certificate of its id. `how` goes to `Daemon`.

    As a Zenoh peer it also serves the programs on its own machine, as the manual describes.
    """
    tables = tomllib.loads(ROBOT_FILE.read_text())
    tables["robot"]["id"] = robot_id
    tables["bus"] |= {"connect": [endpoint], "tls": str(where / robot_id), "mode": mode}
    tables["sim"] = {"faults": ["battery=80:600"]}
    return Daemon(where, config=tables, **{"name": robot_id} | how)


def router(where: Path, endpoint: str) -> Program:
    """Run a router with the Zenoh library of Python. It prints "routing" when it is ready."""
    file = file_for(where)
    return Program(command_line(_ROUTER, file, json.dumps(_changes(file, where, endpoint))), where)


def acsard_router(where: Path, endpoint: str, robots: Sequence[str] = ROBOTS) -> Program:
    """Run `acsard router` with that file. `listens` waits until it listens."""
    file = write_local_copy(file_for(where, robots), where, endpoint)
    return Program(acsard("router", str(file)), where)


def listens(router: Program) -> None:
    """Wait until `acsard router` listens."""
    until(lambda: "router_open" in router.stderr, 10.0, f"the router listens\n{router}")


class Member(Bus):
    """A plain Zenoh client that shows the router a certificate."""

    def __init__(self, config: zenoh.Config, robot_id: str) -> None:
        self.session = zenoh.open(config)
        self.root = f"acsard/{robot_id}"

    def ask(self, key: str, payload: object = None) -> list[Answered]:
        """Return the robot's own answers to a query.

        They are in JSON. Answers from a storage of the router have the encoding of the message.
        """
        answers = []
        every, data = zenoh.ConsolidationMode.NONE, self.payload(key, payload)
        asked = f"{self.root}/{key}"
        for reply in self.session.get(asked, payload=data, consolidation=every, timeout=5.0):
            if reply.ok is not None and str(reply.ok.encoding).startswith("application/json"):
                where = str(reply.ok.key_expr).removeprefix(self.root + "/")
                encoding, value = str(reply.ok.encoding), reply.ok.payload.to_bytes()
                answers.append(Answered(where, True, encoding, value))
        return answers


class Fleet:
    """The router, robot1 and robot2, and a plain client on the machine of each robot."""

    def __init__(self, where: Path) -> None:
        self.where, self.endpoint = where, free_tls_endpoint()
        names = (*ROBOTS, "viewer", "operator", "maintainer", "unlisted", ITS_NAME)
        certified(where, *names)
        self.stack = ExitStack()

    def __enter__(self) -> Fleet:
        try:
            self._open()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.stack.close()

    def _open(self) -> None:
        enter = self.stack.enter_context
        enter(router(self.where, self.endpoint)).says("routing")
        robots = [robot_at(self.endpoint, self.where, name, "peer", ready=False) for name in ROBOTS]
        self.daemons = [enter(daemon) for daemon in robots]
        for daemon in self.daemons:
            daemon.says("bus ")
        pairs = zip(self.daemons, ROBOTS, strict=True)
        self.robots = [enter(Bus(daemon.endpoint, name)) for daemon, name in pairs]
        for robot in self.robots:
            robot.linked()

    def config(self, name: str) -> zenoh.Config:
        """Return the manual's settings for all languages, with this certificate."""
        return secured_config(self.endpoint, self.where / name)

    def member(self, name: str, robot_id: str = "robot1") -> Member:
        """Connect a client with this certificate to the router."""
        return Member(self.config(name), robot_id)
