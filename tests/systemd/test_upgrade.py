"""`acsard service upgrade` and `rollback` in a real systemd, with good and bad new versions.

A version is a copy of the installed one by hard links, with another number and another launcher.
"""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.system.harness import until
from tests.systemd.container import (
    ACSARD,
    CONFIG,
    PORT,
    UNIT,
    USUAL,
    VERSIONS,
    ZERO,
    Board,
    Container,
    Driver,
    Ran,
    UnavailableError,
    unavailable,
)

pytestmark = pytest.mark.systemd

NEW = "9.0.0"
SHORT_S = 6.0
"""Time of the watch in the tests of `.ci/run`."""

BACK_WITHIN_S = 45.0

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


class Robot(NamedTuple):
    """A container with the service, a board and a client that always wants to drive."""

    container: Container
    board: Board
    old: str

    def runs(self) -> str:
        """Return the version from which the daemon's process has its libraries."""
        maps = Path(f"/proc/{self.container.main_pid()}/maps").read_text()
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
        (number,) = re.findall(r'"latch":\s*(\d+)', self.types("get", "state").out)
        return str(number)

    def kept(self) -> dict[str, str]:
        """Return a hash of each file that a change must not touch."""
        places = "/etc/acsard /var/lib/private/acsard-web"
        listed = self.container.types(f"find {places} -type f -exec sha256sum {{}} +").out
        return {name: digest for digest, name in (line.split() for line in listed.splitlines())}

    def recordings(self) -> set[str]:
        return set(self.container.run("ls", "/var/lib/private/acsard/record").out.split())

    def moved(self, since: float) -> list[bytes]:
        """Return the lines with a speed that the board received since then."""
        return [one.line for one in self.board.since(since) if one.line not in (ZERO, b"-")]


@pytest.fixture(scope="module")
def installed(rootfs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    """Provide a systemd in which `acsard service install` has installed the service."""
    try:
        scratch = tmp_path_factory.mktemp("upgrade")
        with Container(rootfs, scratch, "acsard-upgrade") as container:
            container.install()
            container.run("rm", "-rf", VERSIONS)
            container.write(CONFIG, USUAL)
            done = container.run(ACSARD, "service", "install")
            assert done.code == 0, done.err
            yield container
    except UnavailableError as why:
        unavailable(why)


@pytest.fixture
def robot(installed: Container) -> Iterator[Robot]:
    """Provide a robot with the installed version, a link, and nothing else in /opt/acsard."""
    container = installed
    old = container.run(ACSARD, "--version").out.split()[1]
    container.run("systemctl", "stop", UNIT)
    container.types(f"cd {VERSIONS} && ln -sfn {old} current && rm -f previous")
    container.types(
        f"cd {VERSIONS} && find . -mindepth 1 -maxdepth 1 -type d ! -name {old} -exec rm -rf {{}} +"
    )
    container.forget()
    container.run("systemctl", "reset-failed", UNIT)
    with Board(container) as board:
        container.start()
        robot = Robot(container, board, old)
        until(robot.link, 10.0, "the link is up")
        yield robot
    container.path(PORT).unlink(missing_ok=True)


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


@pytest.mark.parametrize("how", ["crashes at once", "has no link", "refuses the configuration"])
def test_the_old_version_runs_again_if_the_new_one_does_not_work(robot: Robot, how: str) -> None:
    robot.makes(NEW, BAD[how])
    robot.stops()
    number, began = robot.latch(), time.monotonic()
    done = robot.changes(NEW)
    assert done.code != 0
    assert NEW in done.err
    assert (robot.readlink(), robot.readlink("previous"), robot.runs()) == (
        robot.old,
        "",
        robot.old,
    )
    assert (robot.latch(), robot.moved(began)) == (number, [])
    assert until(robot.link, 5.0, "the link is up again")


def test_a_driving_robot_is_not_upgraded(robot: Robot) -> None:
    robot.makes(NEW)
    with Driver(robot.container) as driver:
        driver.drives(robot.board)
        pid = robot.container.main_pid()
        done = robot.types("service", "upgrade", f"{VERSIONS}/{NEW}", "--wait", "1")
        assert done.code == 1
        assert "the robot drives" in done.err
        assert (robot.readlink(), robot.container.main_pid()) == (robot.old, pid)
