"""Clients and daemons of two versions work together, and each version reads the other's files.

One version is this tree, and the other one is that of the commit `OTHER`.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from signal import SIGTERM
from typing import Any, NamedTuple

import pytest

from tests.system.harness import (
    ROOT,
    Bus,
    Daemon,
    Finished,
    Peer,
    acsard,
    environment,
    finish,
    until,
)
from tests.tools.interface import last_release

OTHER = "001e0307640b812e62f0702b881cfcaf3abb01b7"  # 0.2.0, the release before


def _has_other() -> bool:
    words = ["git", "-C", str(ROOT), "cat-file", "-e", f"{OTHER}^{{commit}}"]
    return subprocess.run(words, capture_output=True, check=False).returncode == 0


pytestmark = [
    pytest.mark.slow,
    pytest.mark.nightly,
    pytest.mark.skipif(not _has_other(), reason=f"needs a clone that has the commit {OTHER[:8]}"),
]


class Version(NamedTuple):
    """The source of a version, and where its programs run."""

    source: Path
    where: Path

    @property
    def env(self) -> dict[str, str]:
        return environment(PYTHONPATH=str(self.source), STATE_DIRECTORY=str(self.where))

    def daemon(self, port: Path | str = "sim") -> Daemon:
        """Return its daemon. With a real port, it keeps its latches for the next one."""
        record = {"directory": str(self.where / "recordings")}
        return Daemon(self.where, port, {"record": record}, env=self.env)

    def types(self, *words: str) -> Finished:
        return finish(acsard(*words), self.where, 40, self.env)

    def python(self, code: str, **more: str) -> Finished:
        return finish([*acsard()[:1], "-c", code], self.where, 60, self.env | more)


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("other")
    words = f"git -C {ROOT} archive {OTHER} acsard deploy acsard.toml | tar -x -C {place}"
    subprocess.run(["sh", "-c", words], check=True)
    return place


@pytest.fixture(params=["old and new", "new and old"])
def pair(request: pytest.FixtureRequest, other: Path, tmp_path: Path) -> tuple[Version, Version]:
    """Provide the version of the daemon and that of its clients."""
    old, new = Version(other, tmp_path), Version(ROOT, tmp_path)
    return (old, new) if request.param == "old and new" else (new, old)


@pytest.fixture
def running(pair: tuple[Version, Version]) -> Iterator[tuple[Daemon, Bus]]:
    with pair[0].daemon() as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        yield daemon, bus


def test_the_other_version_is_the_release_before_this_one(other: Path) -> None:
    number = f'__version__ = "{last_release().stem}"'
    assert number in (other / "acsard/__init__.py").read_text()


CLIENT = """\
import json
from acsard.client import connect

done = {}
with connect() as robot:
    for name in ("info", "config", "interfaces", "topics", "state", "events", "odom"):
        robot.get(name)
    for name in ("state", "odom", "wheel_states", "beat"):
        assert next(robot.messages(name, timeout=5), None) is not None, name
    done["role"] = robot.whoami().role
    robot.set({"limits.linear_speed": 0.8})
    for verb in ("stop", "clear", "deactivate", "activate", "reset_odometry"):
        robot.call(verb)
    robot.drive(0.3, seconds=0.5)
    robot.move(0.02)
    robot.turn(2)
    done["x"] = robot.pose().x
print(json.dumps(done))
"""


def test_a_client_drives_the_daemon_of_the_other_version(
    pair: tuple[Version, Version], running: tuple[Daemon, Bus]
) -> None:
    _, client = pair
    daemon, _ = running
    ended = client.python(CLIENT, ACSARD_CONFIG=str(daemon.config))
    assert (ended.code, ended.err) == (0, ""), ended
    done = json.loads(ended.out)
    assert done["role"] == "maintainer"
    assert done["x"] > 0.05


def test_tools_show_and_stop_the_daemon_of_the_other_version(
    pair: tuple[Version, Version], running: tuple[Daemon, Bus]
) -> None:
    _, client = pair
    daemon, bus = running
    config = ("--config", str(daemon.config))
    shown = {
        words: client.types(*words, *config)
        for words in (("get", "state"), ("topics",), ("call", "stop"), ("fleet", "--once"))
    }
    assert {words: ended for words, ended in shown.items() if ended.code} == {}
    assert bus.state()["mode"] == "stopped"
    assert "stopped" in shown["fleet", "--once"].out.lower()
    assert client.types("call", "clear", *config).code == 0
    bus.comes_to("ready")


INVITE = """\
from acsard.web.tokens import Vault, place
Vault(place(), "acsar").invite("viewer", "tv", 30)
"""


def test_a_version_reads_what_the_other_one_kept(pair: tuple[Version, Version], peer: Peer) -> None:
    wrote, reads = pair
    with wrote.daemon(peer.path) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        config = ("--config", str(daemon.config))
        for verb in ("deactivate", "stop"):
            assert wrote.types("call", verb, *config).code == 0
        assert wrote.python(INVITE).code == 0
        daemon.signal(SIGTERM)
        assert daemon.ended(5) == 0

    (recording,) = map(str, wrote.where.glob("recordings/*.rec.zst"))
    ended: dict[str, Any] = {
        "list": reads.types("recording", "--directory", str(wrote.where / "recordings")),
        "show": reads.types("recording", "show", recording),
        "export": reads.types("recording", "export", recording, str(wrote.where / "out.mcap")),
        "tokens": reads.types("web", "tokens", *config),
    }
    export = ended.pop("export")
    if reads.source == ROOT:
        # 65: of a robot with other parts, `export` leaves out all before it first rests.
        assert export.code in (0, 65), export
        assert (wrote.where / "out.mcap").stat().st_size > 1000
    else:
        # The configuration of a newer version may have a value that the older one does not know.
        assert export.code == 0 or "expected a number" in export.err, export
    assert {name: end for name, end in ended.items() if end.code} == {}
    assert "stopped by" in ended["show"].out
    assert "tv" in ended["tokens"].out

    with reads.daemon(peer.path) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["mode"] == "stopped", 10.0, "the stop is still latched")
        assert reads.types("call", "clear", *config).code == 0
        bus.comes_to("inactive")
