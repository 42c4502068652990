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
)

pytestmark = pytest.mark.systemd

PLACES = ("/etc", "/opt", "/usr/local/bin")
CONFIGURATION = "/etc/acsard/acsard.toml"
RULES = "/etc/udev/rules.d/70-acsar.rules"
RECORDINGS = ROOT / "tests" / "recordings"


@pytest.fixture(scope="module")
def alone(rootfs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    """Provide a separate systemd, so that no other test depends on files installed here."""
    with Container(rootfs, tmp_path_factory.mktemp("alone"), "acsard-service") as container:
        container.install()
        yield container


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


def test_root_installs_a_running_service_as_a_dry_run_lists_it_and_a_purge_leaves_no_file(
    bare: Container,
) -> None:
    before = listing(bare)
    refused = bare.run("setpriv", "--reuid=65534", ACSARD, "service", "install")
    assert (refused.code, "sudo" in refused.err) == (77, True)
    done = bare.run(ACSARD, "service", "install", "--dry-run")
    assert done.code == 0, done.err
    units = [f"/etc/systemd/system/{unit}" for unit in (UNIT, GATEWAY, PAGE)]
    lines = done.out.splitlines()
    files = [line.split()[1] for line in lines if line.startswith("write")]
    assert files == [*units, RULES, CONFIGURATION]
    assert f"run     systemctl enable --now {UNIT} {GATEWAY} {PAGE}" in done.out
    assert listing(bare) == before

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


@pytest.mark.nightly
def test_the_page_runs_within_its_limits_and_its_end_does_not_end_the_daemon(
    bare: Container,
) -> None:
    bare.write(CONFIGURATION, "")  # the simulator
    assert bare.run(ACSARD, "service", "install").code == 0
    until(lambda: '"mode"' in bare.fetch("/api/state"), 20.0, "the page answers the state")
    assert "stopped and latched" in bare.fetch("/api/srv/stop", "POST")
    assert bare.show("MemoryMax", PAGE) == str(256 << 20)
    daemon, first = bare.main_pid(), bare.main_pid(PAGE)
    bare.run("systemctl", "kill", "--signal=SIGKILL", PAGE)
    until(lambda: bare.show("NRestarts", PAGE) == "1", 10.0, "it is started again")
    until(lambda: "maintainer" in bare.fetch("/api/whoami"), 20.0, "it answers again")
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
    until(lambda: FORMER in bare.fetch("/api/recordings"), 20.0, "what was recorded before")
    until(
        lambda: 'being_recorded":true' in bare.fetch("/api/recordings"),
        20.0,
        "what is recorded now",
    )
    hashed = (
        "import hashlib, urllib.request as url; "
        f"answer = url.urlopen('http://127.0.0.1:8080/api/recordings/{FORMER}'); "
        "print(hashlib.sha256(answer.read()).hexdigest())"
    )
    digest = bare.run("python3", "-c", hashed).out.strip()
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
