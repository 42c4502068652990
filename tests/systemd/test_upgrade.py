"""`acsard service upgrade` and `rollback` in a real systemd, with good and bad new versions.

A version is a copy of the installed one by hard links, with another number and another launcher.
"""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.system.harness import until
from tests.systemd.container import (
    ACSARD,
    CONFIG,
    HOME,
    PORT,
    UNIT,
    USUAL,
    VERSIONS,
    ZERO,
    Board,
    Container,
    Driver,
    Ran,
)

pytestmark = pytest.mark.systemd

NEW = "9.0.0"
INSTALLED = "/srv/installed"
"""A second name of the installed version, because an upgrade removes what is not needed."""
SHORT_S = 10.0
"""Time of the watch of a good version. A busy machine starts the daemon in several seconds."""


# What the launcher of a bad version does first.
_AFTER = "import os, signal, threading; threading.Timer({after}, lambda: {does}).start()"
BAD = {
    "crashes at once": "if 'run' in sys.argv: sys.exit(3)",
    "crashes later": f"if 'run' in sys.argv: {_AFTER.format(after=5.0, does='os._exit(3)')}",
    "hangs at the start": "import time; 'run' in sys.argv and time.sleep(1e6)",
    "hangs later": "if 'run' in sys.argv: "
    + _AFTER.format(after=5.0, does="os.kill(os.getpid(), signal.SIGSTOP)"),
    "refuses the configuration": "if 'check' in sys.argv: sys.exit('no key is right')",
    "refuses the configuration only when it runs": "if 'run' in sys.argv: sys.exit(78)",
    "has no link": "'run' in sys.argv and sys.argv.extend(('--port', '/dev/none'))",
    "has no bus": "'run' in sys.argv and sys.argv.extend(('--listen', 'tcp/127.0.0.1:7999'))",
}


IN_CI = ("crashes at once", "refuses the configuration")


class Robot(NamedTuple):
    """A container with the service, a board and a client that always wants to drive."""

    container: Container
    board: Board
    old: str

    def runs(self) -> str:
        """Return the version from which the daemon's process has its libraries."""
        maps = Path(f"/proc/{self.container.main_pid()}/maps").read_text()
        name: str
        (name,) = set(re.findall(rf"{VERSIONS}/([^/\n]+)/lib/", maps))
        return name

    def readlink(self, name: str = "current") -> str:
        return self.container.run("readlink", f"{VERSIONS}/{name}").out.strip()

    def types(self, *words: str, within_s: float = 150.0) -> Ran:
        """Run acsard to its end."""
        command = self.container.inside("acsard", *words)
        done = subprocess.run(command, capture_output=True, text=True, timeout=within_s)
        return Ran(done.returncode, done.stdout, done.stderr)

    def changes(self, name: str, watch_s: float = SHORT_S) -> Ran:
        """Change the version as `acsard service upgrade` does, with a shorter watch."""
        call = (
            f"import sys; sys.path.insert(0, '{VERSIONS}/{self.readlink()}/lib')\n"
            "from acsard.machine.upgrade import change\n"
            f"change({name!r}, print, wait_s=5.0, watch_s={watch_s})"
        )
        return self.container.run("python3", "-I", "-c", call)

    def makes(self, name: str, first: str = "") -> None:
        """Make a version whose launcher does `first`."""
        new = f"{VERSIONS}/{name}"
        self.container.types(
            f"rm -rf {new} && cp -al {VERSIONS}/{self.old} {new} && "
            f"cp {new}/bin/acsard {new}/launcher && mv {new}/launcher {new}/bin/acsard && "
            f"chmod 755 {new}/bin/acsard"
        )
        launcher = self.container.path(f"{new}/bin/acsard")
        head, _, rest = launcher.read_text().partition("import sys\n")
        launcher.write_text(f"{head}import sys\n{first}\n{rest}")

    def link(self) -> bool:
        return '"link":"up"' in self.types("get", "state").out.replace(" ", "")

    def stops(self) -> None:
        assert self.types("call", "stop").code == 0

    def latch(self) -> str:
        """Return the number of the latched stop."""
        (number,) = re.findall(r'"number":\s*(\d+)', self.types("get", "state").out)
        return str(number)

    def kept(self) -> dict[str, str]:
        """Return a hash of each file that a change must not touch."""
        places = "/etc/acsard /var/lib/private/acsard-web"
        listed = self.container.types(f"find {places} -type f -exec sha256sum {{}} +").out
        return {name: digest for digest, name in (line.split() for line in listed.splitlines())}

    def recordings(self) -> set[str]:
        """Return the numbers of the recordings."""
        names = self.container.run("ls", "/var/lib/private/acsard/record").out.split()
        return {name.partition("-")[0] for name in names}

    def moved(self, since: float) -> list[bytes]:
        """Return the lines with a speed that the board received since then."""
        return [one.line for one in self.board.since(since) if one.line not in (ZERO, b"-")]


@contextmanager
def installing(rootfs: Path, scratch: Path) -> Iterator[Container]:
    """Provide a systemd in which `acsard service install` has installed the service."""
    with Container(rootfs, scratch, "acsard-upgrade") as container:
        container.install()
        container.run("rm", "-rf", VERSIONS)
        container.write(CONFIG, USUAL)
        # A busy machine compiles a copy for over a minute.
        words = container.inside(ACSARD, "service", "install")
        subprocess.run(words, stdout=subprocess.DEVNULL, timeout=300, check=True)
        container.types(f"cp -al {VERSIONS}/[0-9]* {INSTALLED}")
        yield container


@contextmanager
def started(container: Container) -> Iterator[Robot]:
    """Provide a robot with the installed version, a link, and nothing else in /opt/acsard."""
    old = container.run(ACSARD, "--version").out.split()[1]
    container.run("systemctl", "stop", UNIT)
    container.types(
        f"cd {VERSIONS} && rm -rf ./* && cp -al {INSTALLED} {old} && ln -s {old} current"
    )
    container.forget()
    container.run("systemctl", "reset-failed", UNIT)
    with Board(container) as board:
        container.start()
        robot = Robot(container, board, old)
        until(robot.link, 10.0, "the link is up")
        yield robot
    container.path(PORT).unlink(missing_ok=True)


@pytest.fixture(scope="module")
def installed(rootfs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    with installing(rootfs, tmp_path_factory.mktemp("upgrade")) as container:
        yield container


@pytest.fixture
def robot(installed: Container) -> Iterator[Robot]:
    with started(installed) as robot:
        yield robot


def test_an_upgrade_runs_the_new_version_and_a_rollback_the_old_one_with_the_stop_latched(
    robot: Robot,
) -> None:
    robot.makes(NEW)
    robot.stops()
    number, kept, began = robot.latch(), robot.kept(), time.monotonic()
    done = robot.changes(NEW)
    assert done.code == 0, done.err
    assert (robot.readlink(), robot.readlink("previous"), robot.runs()) == (NEW, robot.old, NEW)
    assert robot.latch() == number
    done = robot.changes(robot.readlink("previous"))
    assert done.code == 0, done.err
    assert (robot.readlink(), robot.readlink("previous")) == (robot.old, NEW)
    assert robot.runs() == robot.old
    assert (robot.latch(), robot.kept(), robot.moved(began)) == (number, kept, [])
    # The doctor says that the new version is still there, and does not advise it.
    found = robot.types("doctor", "--config", CONFIG).out
    assert f"{NEW} is installed, but not in use; the service runs {robot.old}" in found


@pytest.mark.parametrize(
    "how", [pytest.param(how, marks=() if how in IN_CI else pytest.mark.nightly) for how in BAD]
)
def test_the_old_version_runs_again_if_the_new_one_does_not_work(robot: Robot, how: str) -> None:
    robot.makes(NEW, BAD[how])
    robot.stops()
    number, began = robot.latch(), time.monotonic()
    done = robot.changes(NEW, watch_s=8.0 if "later" in how else 4.0)
    assert done.code != 0
    assert NEW in done.err
    assert (robot.readlink(), robot.readlink("previous"), robot.runs()) == (
        robot.old,
        "",
        robot.old,
    )
    assert (robot.latch(), robot.moved(began)) == (number, [])
    assert until(robot.link, 10.0, "the link is up again")


def test_a_driving_robot_is_not_upgraded(robot: Robot) -> None:
    robot.makes(NEW)
    with Driver(robot.container) as driver:
        driver.drives(robot.board)
        pid = robot.container.main_pid()
        done = robot.types("service", "upgrade", f"{VERSIONS}/{NEW}", "--wait", "1")
        assert done.code == 1
        assert "the robot drives" in done.err
        assert (robot.readlink(), robot.container.main_pid()) == (robot.old, pid)


KILLS = 6


def commanded(robot: Robot, *words: str) -> Ran:
    """Run a subcommand of `acsard service` that changes the version."""
    return robot.types("service", *words)


def environment(robot: Robot, number: str) -> str:
    """Make a venv with another version of acsard, and return its directory in the container."""
    place = f"/srv/{number}"
    robot.container.types(
        f"rm -rf {place} && mkdir {place} && cp -r {HOME}/venv {place}/venv && "
        f"mkdir {place}/src && cp -r {HOME}/src/acsard {HOME}/src/deploy {HOME}/src/acsard.toml "
        f"{place}/src && sed -i 's/^__version__ = .*/__version__ = \"{number}\"/' "
        f"{place}/src/acsard/__init__.py && sed -i 's|{HOME}/src|{place}/src|' "
        f"{place}/venv/lib/*/site-packages/acsard.pth && "
        f"ln -sf $(readlink {HOME}/venv/bin/python) {place}/venv/bin/python"
    )
    return f"{place}/venv"


@pytest.mark.nightly
def test_an_environment_is_upgraded_to_by_its_directory(robot: Robot) -> None:
    place = environment(robot, "9.1.0")
    done = commanded(robot, "upgrade", place)
    assert done.code == 0, done
    assert (robot.readlink(), robot.runs()) == ("9.1.0", "9.1.0")
    assert '"version":"9.1.0"' in robot.types("get", "info").out.replace(" ", "")
    assert commanded(robot, "rollback").code == 0
    assert robot.runs() == robot.old


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_an_upgrade_that_is_killed_at_any_moment_leaves_a_version_that_starts(
    robot: Robot,
) -> None:
    """Half of the upgrades copy an environment, and a third of the kills are after the change."""
    moments = random.Random(68)
    place = environment(robot, "9.1.0")
    robot.stops()
    number, kept, began = robot.latch(), robot.kept(), time.monotonic()
    started: dict[str, int] = {}
    with Driver(robot.container) as driver:
        driver.sends(0.3)
        for n in range(KILLS):
            # Each change has removed the versions that are not needed.
            robot.makes(NEW)
            robot.container.run("rm", "-rf", f"{VERSIONS}/9.1.0")
            new = f"{VERSIONS}/{NEW}" if n % 2 else place
            # The change is between these two messages.
            after, within_s = (("", 20.0), ("waiting until", 4.0), ("watching it", 8.0))[n // 2 % 3]
            command = robot.container.inside("acsard", "service", "upgrade", new)
            with subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                start_new_session=True,
            ) as process:  # fmt: skip
                assert process.stdout is not None
                assert not after or any(after in line for line in process.stdout)
                time.sleep(moments.uniform(0.0, within_s))
                os.killpg(process.pid, signal.SIGKILL)
            assert process.returncode == -signal.SIGKILL
            robot.container.run("systemctl", "restart", UNIT)
            assert robot.container.show("ActiveState") == "active"
            name = robot.readlink()
            assert robot.runs() == name
            assert after != "watching it" or name != robot.old
            until(robot.link, 10.0, "the link is up")
            assert (robot.latch(), robot.kept()) == (number, kept)
            print(f"{n + 1} of {KILLS}: killed after {after or 'the start'!r}, {name} starts")
            started[name] = started.get(name, 0) + 1
            if name != robot.old:
                done = robot.changes(robot.old)
                assert done.code == 0, done.err
    assert robot.moved(began) == []
    print(f"started after {KILLS} kills: {started}")


@pytest.mark.nightly
def test_with_a_full_disk_the_old_version_runs_on_and_no_part_of_the_new_one_stays(
    robot: Robot,
) -> None:
    container = robot.container
    place = environment(robot, "9.1.0")
    container.run("systemctl", "stop", UNIT)
    try:
        container.types(
            f"mount -t tmpfs -o size=1g none /opt && mkdir {VERSIONS} && cd {VERSIONS} && "
            f"cp -a {INSTALLED} {robot.old} && ln -s {robot.old} current"
        )
        container.start()
        used = int(container.types("du -sm /opt").out.split()[0])
        container.types(f"mount -o remount,size={used + 40}m /opt")
        until(robot.link, 10.0, "the link is up")
        pid, before = container.main_pid(), container.types(f"ls -A {VERSIONS}").out
        done = commanded(robot, "upgrade", place)
        assert (done.code, "No space left on device" in done.out + done.err) == (1, True), done
        assert container.main_pid() == pid
        assert robot.link()
        assert container.types(f"ls -A {VERSIONS}").out == before
    finally:
        container.run("systemctl", "stop", UNIT)
        container.run("umount", "/opt")
