"""The packages install, drive, upgrade and go in bare roots of Debian and Ubuntu."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ANY_SPEED
from tests.release.debian_root import (
    MACHINES,
    NEWER,
    NUMBER,
    SYSTEMS,
    Root,
    debian_version,
    missing_programs,
    newer,
    package,
    packages,
    packages_of_tests,
    root,
    runs_arm64,
)
from tests.system.chromium import CHROMIUM, PHONE, Browser, browsing
from tests.system.harness import ROOT, Program, until
from tests.system.hosts import inside, ip, on
from tests.system.terminals import Terminal
from tests.system.test_versions import OTHER
from tests.systemd.container import CONFIG, GATEWAY, PAGE, UNIT, Board, Container
from tests.systemd.test_upgrade import BAD, Robot, commanded

pytestmark = [
    pytest.mark.systemd,
    pytest.mark.nightly,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(bool(missing_programs()), reason=missing_programs()),
]

# All take hours on an emulated processor. These are the line, the guard, the drive, the bytes of
# the messages, and recorded drives, which must replay to the bit.
EMULATED = (
    "tests/unit/test_link_line.py tests/unit/test_drive*.py tests/unit/test_messages_*.py "
    "tests/test_recordings.py"
)

LIMIT_MB = 60

OF_A_CLONE = (
    # With the package's gateway, `tls init` also writes its drop-in.
    "tests/unit/test_cli_transcripts.py::test_each_command_prints_what_its_transcript_says[tls]",
)


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide the directory of the packages and of the archives of the roots."""
    named = os.environ.get("ACSARD_TEST_DEBS")
    where = Path(named) if named else tmp_path_factory.mktemp("debs")
    where.mkdir(parents=True, exist_ok=True)
    return where


@pytest.fixture(scope="session")
def made(place: Path) -> list[Path]:
    """Provide the six packages."""
    return packages(place / "packages")


@pytest.fixture
def bare(request: pytest.FixtureRequest, place: Path, made: list[Path]) -> Iterator[Root]:
    """Provide a new root of the system and the architecture that the test names.

    It has the package of this version, and that of a newer one.
    """
    system, machine = request.param
    if (system, machine) == ("ubuntu24.04", "arm64"):
        pytest.skip("Ubuntu has its arm64 packages on another server")
    if machine == "arm64" and not runs_arm64():
        pytest.skip("needs qemu-user-static")
    with root(place, system, machine) as bare:
        deb = package(made, system, machine)
        shutil.copyfile(deb, bare.path / deb.name)
        newer(deb, bare.path)
        yield bare


on_each = pytest.mark.parametrize(
    "bare", [(system, machine) for system in SYSTEMS for machine in MACHINES],
    indirect=True, ids="-".join,
)  # fmt: skip
on_amd64 = pytest.mark.parametrize(
    "bare", [(system, "amd64") for system in SYSTEMS], indirect=True, ids="-".join
)


def _serves(host: str) -> bool:
    with inside(host), socket.socket() as connection:
        return connection.connect_ex(("127.0.0.1", 8080)) == 0


def _drive(browser: Browser) -> None:
    browser.size(*PHONE)
    browser.open("http://localhost:8080")
    until(lambda: "READY" in browser.text("mode"), 60.0, "the page shows the robot")
    browser.hold(lambda: "DRIVING" in browser.text("mode"))
    browser.lift()


def deb(number: str) -> str:
    """Return a shell pattern of this version's package."""
    return f"/acsard_{debian_version(number)}-*.deb"


@on_each
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell")
def test_two_commands_lead_from_a_bare_system_to_driving_in_a_browser(bare: Root) -> None:
    host = f"acsard{os.getpid()}d"
    ip("netns", "add", host)
    try:
        ip("-n", host, "link", "set", "lo", "up")
        began = time.monotonic()
        # An emulated Python compiles Debian's libraries for many minutes.
        bare.run(f"apt-get install --yes {deb(NUMBER)}", within=3000.0)
        installed = time.monotonic()
        words = bare.words("acsard", "run", "--port", "sim")
        with Terminal() as terminal:
            streams: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), terminal.slave)
            daemon = Program(words, "/", start_new_session=True, **streams)
            with on(host, daemon), browsing(host) as browser:
                until(lambda: _serves(host), 300.0, "a page")
                _drive(browser)
        print(f"{installed - began:.0f} s to install, {time.monotonic() - began:.0f} s to drive")
    finally:
        ip("netns", "delete", host, check=False)


@on_each
def test_it_takes_60_mb_and_every_module_imports(bare: Root) -> None:
    bare.run(f"apt-get install --yes --no-install-recommends {deb(NUMBER)}")
    files = bare.run("dpkg-query --listfiles acsard").splitlines()
    paths = [bare.path / name.lstrip("/") for name in files]
    paths += bare.path.glob("opt/acsard/[0-9]*/**/*")
    inodes = {path.lstat().st_ino: path.lstat().st_size for path in paths if not path.is_dir()}
    # The hard links in dist/ and beside it are one file.
    size_mb = sum(inodes.values()) / 1e6
    print(f"{size_mb:.1f} MB")
    assert size_mb <= LIMIT_MB
    bare.run("apt-get install --yes --no-install-recommends python3-numpy")
    code = (
        "import importlib, pkgutil, acsard\n"
        "for module in pkgutil.walk_packages(acsard.__path__, 'acsard.'):\n"
        "    if not module.name.startswith(('acsard.foxglove', 'acsard.__main__')):\n"
        "        importlib.import_module(module.name)\n"
        "import aiohttp.web, cryptography.x509, zstandard, lz4.frame, mcap.reader, zenoh\n"
        "assert zstandard.decompress(zstandard.compress(b'a')) == b'a'\n"
        "assert lz4.frame.decompress(lz4.frame.compress(b'a')) == b'a'\n"
        "print('all')\n"
    )
    (bare.path / "imports.py").write_text(code)
    python = "PYTHONPATH=/opt/acsard/current/lib python3 -P"
    assert bare.run(f"{python} /imports.py") == "all\n"
    assert "sudo apt install python3-numpy" not in bare.run("acsard calibrate --help")


@pytest.mark.parametrize(
    "bare",
    [*((system, "amd64") for system in SYSTEMS), ("deb12", "arm64")],
    indirect=True,
    ids="-".join,
)
def test_the_unit_tests_pass_on_the_installed_files(bare: Root, place: Path) -> None:
    bare.run(f"apt-get install --yes {deb(NUMBER)} git", within=3000.0)
    packages = packages_of_tests(place, bare.system, bare.machine)
    shutil.copytree(packages, bare.path / "packages")
    for name in ("tests", "deploy", "README.md", "pyproject.toml", "acsard.toml"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile
        (bare.path / "clone").mkdir(exist_ok=True)
        copy(ROOT / name, bare.path / "clone" / name)
    # Some tests read the source.
    (bare.path / "clone/acsard").symlink_to("/opt/acsard/current/lib/acsard")
    files = "tests/unit" if bare.machine == "amd64" else EMULATED
    left_out = " ".join(f"--deselect '{name}'" for name in OF_A_CLONE)
    told = bare.run(
        # Some tests list all processes, and others of this machine may use the same ptys.
        f"cd /clone && {ANY_SPEED}=1 PYTHONPATH=/opt/acsard/current/lib:/packages "
        "unshare --pid --fork --mount-proc --propagation unchanged "
        "python3 -P -m pytest --import-mode=append -p no:cacheprovider -q -n 2 --timeout 600 "
        f"{files} {left_out}",
        within=3000.0,
    )
    assert " passed" in told.splitlines()[-1]
    print(told.splitlines()[-1])


@on_amd64
def test_an_upgrade_switches_nothing_and_purge_leaves_nothing(bare: Root) -> None:
    apt = "apt-get install --yes --no-install-recommends"
    bare.run(f"{apt} python3")
    before = bare.files()
    # dpkg removes /opt with the last package that has files there.
    del before["/opt"]
    bare.run(f"{apt} {deb(NUMBER)}")
    config = bare.path / CONFIG.lstrip("/")
    assert 'port = "/dev/acsar"' in config.read_text()
    config.write_text("# mine\n")

    bare.run(f"{apt} {deb(NEWER)}")
    assert os.readlink(bare.path / "opt/acsard/current") == NUMBER
    assert NUMBER in bare.run("acsard --version")
    assert NEWER in bare.run(f"/opt/acsard/{NEWER}/bin/acsard --version")
    assert config.read_text() == "# mine\n"
    assert sorted(os.listdir(bare.path / "opt/acsard/dist")) == [NEWER]

    bare.run("apt-get remove --yes acsard")
    assert not (bare.path / "opt/acsard").exists()
    assert config.read_text() == "# mine\n"
    bare.run(f"{apt} {deb(NEWER)}")
    assert os.readlink(bare.path / "opt/acsard/current") == NEWER
    assert config.read_text() == "# mine\n"

    bare.run("apt-get purge --yes acsard")
    assert bare.files() == before


@pytest.mark.skipif(shutil.which("lintian") is None, reason="no lintian")
def test_lintian_finds_nothing_that_no_override_explains(made: list[Path]) -> None:
    words = ["lintian", "--info", "--allow-root", *map(str, made)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


MANUAL = ("python3", "-c", "import urllib.request as url; "
          "print(url.urlopen('http://127.0.0.1:8080/docs').read().decode())")  # fmt: skip


def _copied(bare: Root, *debs: Path) -> None:
    """Give a root systemd and packages."""
    bare.run("apt-get install --yes --no-install-recommends systemd-sysv dbus udev python3")
    for deb in debs:
        shutil.copyfile(deb, bare.path / deb.name)


def test_the_first_installation_starts_the_service_and_no_upgrade_restarts_it(
    made: list[Path], place: Path, tmp_path: Path
) -> None:
    with root(place, "deb12", "amd64") as bare:
        first = package(made, "deb12", "amd64")
        second = newer(first, bare.path)
        _copied(bare, first)
        with Container(bare.path, tmp_path, "acsard-deb") as container:
            done = container.run("dpkg", "--install", f"/{first.name}")
            assert done.code == 0, done.err
            for unit in (UNIT, GATEWAY, PAGE):
                assert container.run("systemctl", "is-enabled", unit).out == "enabled\n"
            for unit in (UNIT, PAGE):
                assert container.show("ActiveState", unit) == "active", container.messages(unit)
            status = container.run("acsard", "service", "status")
            assert (status.code, "missing" in status.out) == (0, False), status.out
            until(lambda: "The manual of acsard" in container.run(*MANUAL).out, 20.0, "a manual")
            refused = container.run("acsard", "service", "uninstall", "--purge")
            assert (refused.code, "sudo apt remove acsard" in refused.err) == (1, True)
            assert container.show("ActiveState") == "active"
            container.types(f"acsard tls init --write {CONFIG}", "/")
            container.types("systemctl daemon-reload && systemctl restart acsard", "/")
            until(lambda: container.show("ActiveState", GATEWAY) == "active", 20.0, "a gateway")

            daemon = container.main_pid()
            done = container.run("dpkg", "--install", f"/{second.name}")
            assert done.code == 0, done.err
            assert container.main_pid() == daemon
            assert NUMBER in container.run("acsard", "--version").out
            # dpkg has replaced the unit in /usr/lib, so the version in use has its own in /etc.
            assert container.show("FragmentPath") == f"/etc/systemd/system/{UNIT}"
            assert container.run("systemctl", "is-enabled", UNIT).out == "enabled\n"
            used = f"/opt/acsard/{NUMBER}/lib/acsard/deploy/systemd/{UNIT}"
            container.types(f"cmp {used} /etc/systemd/system/{UNIT}", "/")

            container.run("systemctl", "stop", PAGE, GATEWAY, UNIT)
            container.run("dpkg", "--install", f"/{second.name}")
            assert container.show("ActiveState") == "inactive"

            container.run("systemctl", "start", UNIT)
            done = container.run("dpkg", "--purge", "acsard")
            assert done.code == 0, done.err
            left = container.run("find", "/", "-xdev", "-name", "*acsa*", "-not", "-name", "*.deb")
            # The container itself has a clone there.
            assert [path for path in left.out.split() if not path.startswith("/srv/acsard")] == []


AWAY, TLS = "https://robot.local:8443", "/etc/acsard/tls"


@pytest.fixture(scope="session")
def before(place: Path) -> list[Path]:
    """Provide the packages of the release before this one."""
    return packages(place / "before", OTHER)


@pytest.mark.parametrize("system", ["deb12", "deb13"])
def test_the_release_before_is_upgraded_and_back_and_goes_back_from_a_bad_version(
    system: str, before: list[Path], made: list[Path], place: Path, tmp_path: Path
) -> None:
    first, second = (package(debs, system, "amd64") for debs in (before, made))
    old = first.name.removeprefix("acsard_").partition("-")[0]
    with root(place, system, "amd64") as bare:
        _copied(bare, first, second)
        with Container(bare.path, tmp_path, "acsard-deb") as container, Board(container) as board:
            done = container.run("dpkg", "--install", f"/{first.name}")
            assert done.code == 0, done.err
            robot = Robot(container, board, old)
            until(robot.link, 60.0, "the link is up")
            for words in (
                ("set", "limits.linear_speed", "0.4", "--keep", "--config", CONFIG),
                ("tls", "init", "--directory", TLS, "--address", "robot.local"),
                ("web", "--config", CONFIG, "--address", AWAY, "--tls", TLS, "invite", "viewer"),
                ("call", "stop"),
            ):
                done = robot.types(*words)
                assert done.code == 0, done
            until(robot.recordings, 30.0, "a recording has begun")
            number, kept, recordings = robot.latch(), robot.kept(), robot.recordings()
            assert (number != "0", len(kept) > 1, len(recordings)) == (True, True, 1)
            pid, began = container.main_pid(), time.monotonic()

            def runs(new: str, previous: str) -> None:
                links = (robot.readlink(), robot.readlink("previous"), robot.runs())
                assert links == (new, previous, new)
                info = robot.types("get", "info").out.replace(" ", "")
                assert f'"version":"{new}"' in info
                assert (robot.link(), robot.latch()) == (True, number)
                # The page writes the time into the file of its tokens.
                changed = {name for name, _ in kept.items() - robot.kept().items()}
                assert changed <= {"/var/lib/private/acsard-web/tokens.json"}
                assert "viewer" in robot.types("web", "--config", CONFIG, "tokens").out
                assert recordings <= robot.recordings()
                # The unit in use is this version's own.
                used = f"/opt/acsard/{new}/lib/acsard/deploy/systemd/{UNIT}"
                container.types(f"cmp {used} /etc/systemd/system/{UNIT}", "/")

            for how in ("crashes later", "has no link", "refuses the configuration"):
                container.run("dpkg", "--install", f"/{second.name}")
                Robot(container, board, NUMBER).makes("9.0.0", BAD[how])
                change = commanded(robot, "upgrade", "/opt/acsard/9.0.0")
                print(how, change.out, change.err, sep="\n")
                assert change.code == 1
                runs(old, "")

            for change_words, new, previous in (
                (("upgrade", f"/{second.name}"), NUMBER, old),
                (("rollback",), old, NUMBER),
                (("rollback",), NUMBER, old),
            ):
                change = commanded(robot, *change_words)
                print(change.out, change.err)
                assert change.code == 0, change.out
                assert container.main_pid() != pid
                pid = container.main_pid()
                runs(new, previous)
            assert robot.moved(began) == []
            shown = robot.types("recording", "--directory", "/var/lib/acsard/record")
            assert shown.out.count("\n") > len(recordings)
            assert '"linear_speed":0.4' in robot.types("get", "config").out.replace(" ", "")
            assert robot.types("call", "clear").code == 0
