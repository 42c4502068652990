"""`acsard service` installs a running service in a real systemd, and removes it without a trace."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from acsard.machine.authority import Authority
from tests.system.harness import ROOT, until
from tests.systemd.container import (
    ACSARD,
    GATEWAY,
    HOME,
    PAGE,
    UNIT,
    VERSIONS,
    Container,
    unavailable,
)
from tests.systemd.image import UnavailableError

pytestmark = pytest.mark.systemd

PLACES = ("/etc", "/opt", "/usr/local/bin")
CONFIGURATION = "/etc/acsard/acsard.toml"
RULES = "/etc/udev/rules.d/70-acsar.rules"
RECORDINGS = ROOT / "tests" / "recordings"


@pytest.fixture(scope="module")
def alone(rootfs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    """Provide a separate systemd, so that no other test depends on files installed here."""
    try:
        with Container(rootfs, tmp_path_factory.mktemp("alone"), "acsard-service") as container:
            container.install()
            yield container
    except UnavailableError as why:
        unavailable(why)


@pytest.fixture
def bare(alone: Container) -> Iterator[Container]:
    """Provide a systemd with the program but without the service, as `pip install` leaves it."""
    clean = "rm -rf /etc/systemd/system/acsard* /opt/acsard /etc/acsard"
    alone.run("systemctl", "stop", PAGE, GATEWAY, UNIT)
    alone.run("sh", "-c", clean)
    alone.run("systemctl", "daemon-reload")
    yield alone
    alone.run(ACSARD, "service", "uninstall")


def listing(container: Container) -> set[str]:
    """Return every file of acsard and of the administrator in the container, with its size."""
    files = set()
    for place in PLACES:
        for path in container.path(place).rglob("*"):
            size = path.lstat().st_size if path.is_file() else 0
            files.add(f"{path.relative_to(container.path('/'))} {size}")
    return files


def written(out: str) -> list[str]:
    return [line.split()[1] for line in out.splitlines() if line.startswith("write")]


def test_a_dry_run_prints_every_file_and_command_and_touches_nothing(bare: Container) -> None:
    before = listing(bare)
    done = bare.run(ACSARD, "service", "install", "--dry-run")
    assert done.code == 0, done.err
    assert listing(bare) == before
    assert written(done.out) == [
        f"/etc/systemd/system/{UNIT}",
        f"/etc/systemd/system/{GATEWAY}",
        f"/etc/systemd/system/{PAGE}",
        RULES,
        CONFIGURATION,
    ]
    assert f"run     systemctl enable --now {UNIT} {GATEWAY} {PAGE}" in done.out


def test_the_service_runs_after_install_and_leaves_no_file_after_a_purge(bare: Container) -> None:
    before = listing(bare)
    done = bare.run(ACSARD, "service", "install")
    assert done.code == 0, done.out + done.err
    assert bare.show("ActiveState") == "active"
    until(lambda: "/dev/acsar" in bare.show("StatusText"), 5.0, "it waits for the board")
    assert bare.show("UnitFileState") == "enabled"
    status = bare.run(ACSARD, "service", "status")
    assert (status.code, status.out.count("as installed")) == (0, 5)
    # The service uses neither the clone nor its venv.
    maps = Path(f"/proc/{bare.main_pid()}/maps").read_text()
    assert f"{VERSIONS}/" in maps
    assert HOME not in maps
    result = bare.run("acsard", "service", "uninstall", "--purge")
    assert result.code == 0, result.out + result.err
    assert listing(bare) == before
    assert bare.show("LoadState") == "not-found"
    assert bare.run(ACSARD, "service", "status").code == 1


def asks(container: Container, path: str, *more: str) -> str:
    """Return the page's answer to a client in the container.

    The client is a Python program, because the container has no curl. It sends a POST if `more` is
    given.
    """
    return container.run("python3", "-c", ASK, f"http://127.0.0.1:8080{path}", *more).out


ASK = """\
import sys
from urllib.error import HTTPError
from urllib.request import Request, urlopen

try:
    answer = urlopen(Request(sys.argv[1], *(b"" for _ in sys.argv[2:])))
except HTTPError as refused:
    answer = refused
print(answer.read().decode())
"""


@pytest.mark.nightly
def test_the_page_runs_within_its_limits_and_its_end_does_not_end_the_daemon(
    bare: Container,
) -> None:
    bare.write(CONFIGURATION, "")  # the simulator
    assert bare.run(ACSARD, "service", "install").code == 0
    until(lambda: '"mode"' in asks(bare, "/api/state"), 20.0, "the page answers the state")
    assert "stopped and latched" in asks(bare, "/api/srv/stop", "POST")
    assert bare.show("MemoryMax", PAGE) == str(256 << 20)
    daemon, first = bare.main_pid(), bare.main_pid(PAGE)
    bare.run("systemctl", "kill", "--signal=SIGKILL", PAGE)
    until(lambda: bare.show("NRestarts", PAGE) == "1", 10.0, "it is started again")
    until(lambda: "maintainer" in asks(bare, "/api/whoami"), 20.0, "it answers again")
    assert bare.main_pid(PAGE) != first
    assert bare.main_pid() == daemon
    Authority.make(bare.path(TLS), "test", 1).issue(bare.path(TLS), "robot", ["127.0.0.1"], 1)
    away = ("--address", "https://0.0.0.0:8443", "--tls", TLS)
    result = bare.run(ACSARD, "web", "invite", "viewer", *away)
    assert result.code == 0, result.err
    attributes = bare.run(
        "stat", "-L", "-c", "%a %u", "/var/lib/acsard-web/tokens.json"
    ).out.split()
    owner = bare.run("stat", "-L", "-c", "%u", "/var/lib/acsard-web").out.strip()
    assert attributes == ["600", owner]


TLS = "/root/tls"
"""A robot's certificate, for clients from other hosts."""

STATE = "/var/lib/private/acsard"
FORMER = "000001-20260101T000000Z.rec.zst"


def recorded_before(container: Container) -> bytes:
    """Store a recording as an earlier version of the service left it, and return its bytes.

    That version's files belong to a user id that systemd assigned for one run.
    """
    (recording, *_) = sorted(RECORDINGS.glob("*.rec.zst"), key=lambda path: path.stat().st_size)
    container.run("sh", "-c", f"rm -rf {STATE} && install -d -m 700 {STATE.rpartition('/')[0]}")
    place = container.path(f"{STATE}/record")
    place.mkdir(parents=True)
    (place / FORMER).write_bytes(recording.read_bytes())
    for path, mode in ((place.parent, 0o750), (place, 0o750), (place / FORMER, 0o644)):
        os.chown(path, 61999, 61999)
        path.chmod(mode)
    container.run("ln", "-sfn", "private/acsard", "/var/lib/acsard")
    return recording.read_bytes()


FETCHED = """\
import hashlib, sys
from urllib.request import urlopen

print(hashlib.sha256(urlopen(sys.argv[1]).read()).hexdigest())
"""

PROBE = """\
import errno, json, os, sys

daemon, place, name = int(sys.argv[1]), *sys.argv[2:]
one = f"{place}/{name}"


def came_of(tried):
    try:
        tried()
    except OSError as error:
        return errno.errorcode[error.errno]
    return "done"


print(json.dumps({
    "read": came_of(lambda: open(one, "rb").close()),
    "make": came_of(lambda: open(f"{place}/new", "w").close()),
    "append": came_of(lambda: open(one, "ab").close()),
    "remove": came_of(lambda: os.unlink(one)),
    "rename": came_of(lambda: os.rename(one, f"{place}/other")),
    "chmod": came_of(lambda: os.chmod(one, 0o600)),
    "signal": came_of(lambda: os.kill(daemon, 0)),
    "environment": came_of(lambda: open(f"/proc/{daemon}/environ").close()),
    "private": sorted(os.listdir("/var/lib/private")),
}))
"""
"""A program that runs where the page runs, in its whole sandbox."""


@pytest.mark.nightly
def test_the_service_s_page_lists_and_serves_recordings_and_cannot_change_them(
    bare: Container,
) -> None:
    recording = recorded_before(bare)
    bare.write(CONFIGURATION, "")  # the simulator
    done = bare.run(ACSARD, "service", "install")
    assert done.code == 0, done.err + bare.messages()
    until(lambda: FORMER in asks(bare, "/api/recordings"), 20.0, "what was recorded before")
    until(
        lambda: 'being_recorded":true' in asks(bare, "/api/recordings"),
        20.0,
        "what is recorded now",
    )
    fetched = f"http://127.0.0.1:8080/api/recordings/{FORMER}"
    digest = bare.run("python3", "-c", FETCHED, fetched).out.strip()
    assert digest == hashlib.sha256(recording).hexdigest()

    bare.write("/srv/probe.py", PROBE)
    words = f"{bare.show('MainPID')} /var/lib/acsard/record {FORMER}"
    walls = f"ExecStartPre=/usr/bin/python3 /srv/probe.py {words}"
    bare.drop_in("probe.conf", f"[Service]\n{walls}\n", PAGE)
    bare.run("systemctl", "restart", PAGE)
    lines = [line for line in bare.messages(PAGE).splitlines() if line.startswith('{"read"')]
    report = json.loads(lines[-1])
    assert report.pop("private") == ["acsard", "acsard-web"]
    assert (report.pop("read"), report.pop("signal")) == ("done", "EPERM")
    assert set(report.values()) <= {"EACCES", "EROFS", "ENOENT", "EPERM"}, report

    assert bare.run(ACSARD, "service", "uninstall", "--purge").code == 0
    assert not bare.path(STATE).exists()
    assert not bare.path(f"{STATE}-web").exists()  # a new instance accepts no old invitation


def test_only_root_installs(bare: Container) -> None:
    asked = f"setpriv --reuid=65534 {ACSARD} service install"
    done = bare.run("sh", "-c", asked)
    assert done.code == 77
    assert "sudo" in done.err
    assert not Path(bare.path(CONFIGURATION)).exists()
