"""Make, boot, inspect and end a real systemd in a container.

The container has its own processes, network, mounts and cgroup, so the tests do not touch the
host's services. Container and host have the same monotonic clock.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest

from tests.system.harness import FAR, ROOT, FarPeer, Program, until
from tests.systemd.image import OURS, SUITES, cgroups

UNIT, GATEWAY, PAGE = "acsard.service", "acsard-gateway.service", "acsard-web.service"

HOME = "/srv/acsard"
"""Directory of the clone, its packages and the venv from which the service is installed."""

VERSIONS = "/opt/acsard"

LENT = f"{HOME}/python"
"""Mount point of our own Python, if Debian's is another."""

PORT = "/dev/acsar"

CONFIG = "/etc/acsard/acsard.toml"

USUAL = f'[mcu]\nport = "{PORT}"\n'

ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00"

UNITS = "/etc/systemd/system"

STATES = "/var/lib/private"
"""Directory of the services' state directories."""

LIES = "/run/board-lies"
"""While this file is there, the board reports speeds that no wheel can have."""

ACSARD = f"{HOME}/venv/bin/acsard"


def unavailable(why: object) -> NoReturn:
    """Skip the test, or fail it if $ACSARD_TEST_SYSTEMD is "must", as in CI."""
    text = f"cannot boot a systemd: {why}"
    if os.environ.get("ACSARD_TEST_SYSTEMD") == "must":
        pytest.fail(text, pytrace=False)
    pytest.skip(text)


class Ran(NamedTuple):
    """The result of a command in the container."""

    code: int
    out: str
    err: str


class Container:
    """A booted systemd. The end of the `with` ends it and all its processes.

    If this machine cannot boot it, the test is skipped, or fails in CI.
    """

    def __init__(
        self, rootfs: Path, scratch: Path, name: str = "acsard-test", keeps: Path | None = None
    ) -> None:
        """Prepare a container. The directory `keeps` preserves the services' state over reboots."""
        self._rootfs, self._log, self._name = rootfs, scratch / "console", name
        self._keeps = keeps
        root = cgroups()
        assert root is not None
        self._cgroup = root / f"{name}-{os.getpid()}"
        self.leader = 0
        """systemd's process id on the host."""

    def __enter__(self) -> Container:
        try:
            self._cgroup.mkdir()
        except OSError as error:
            unavailable(f"no cgroup of our own: {error}")
        procs = self._cgroup / "cgroup.procs"
        words = ["sh", "-c", 'echo $$ > "$0" && exec "$@"', str(procs), "systemd-nspawn"]
        words += ["--quiet", "--boot", "--register=no", "--keep-unit", "--private-network"]
        words += ["--volatile=overlay", f"--machine={self._name}", "--console=pipe"]
        # Without these, systemd cannot enforce IPAddressDeny= and DevicePolicy=.
        words += ["--capability=CAP_BPF", "--system-call-filter=@memlock bpf"]
        words += [f"--directory={self._rootfs}"]
        ours = ("acsard", "deploy", "acsard.toml")
        words += [f"--bind-ro={ROOT / name}:{HOME}/src/{name}" for name in ours]
        words += [f"--bind-ro={sysconfig.get_path('purelib')}:{HOME}/packages"]
        if OURS not in SUITES:
            words += [f"--bind-ro={sys.base_prefix}:{LENT}"]
        if self._keeps is not None:
            words += [f"--bind={self._keeps}:{STATES}"]
        settings = {"SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"}
        settings |= {"SYSTEMD_NSPAWN_API_VFS_WRITABLE": "yes"}
        with self._log.open("wb") as log:
            self._nspawn = subprocess.Popen(
                words, env=os.environ | settings, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        try:
            self.leader = until(self._find_leader, 10.0, "a systemd")
            until(self._is_up, 30.0, "systemd has started everything")
        except AssertionError as error:
            self.__exit__()
            console = self._log.read_text(errors="replace")[-500:]
            unavailable(f"{error}: {console}")
        # Before this, systemd mistakes the container's cgroup for the host's.
        self.run("systemctl", "daemon-reexec")
        return self

    def __exit__(self, *error: object) -> None:
        if self._nspawn.poll() is None:
            self._nspawn.send_signal(signal.SIGTERM)
            try:
                self._nspawn.wait(10.0)
            except subprocess.TimeoutExpired:
                (self._cgroup / "cgroup.kill").write_text("1")
                self._nspawn.wait(10.0)
        for directory, _, _ in os.walk(self._cgroup, topdown=False):
            try:
                os.rmdir(directory)
            except OSError:
                pass  # the kernel is still removing one of its processes

    def _find_leader(self) -> int:
        if self._nspawn.poll() is not None:
            raise AssertionError(f"systemd-nspawn ended with {self._nspawn.returncode}")
        pids = Path(f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children").read_text()
        for pid in map(int, pids.split()):
            with suppress(OSError):  # it has ended meanwhile
                if Path(f"/proc/{pid}/comm").read_text().strip() == "systemd":
                    return pid
        return 0

    def _is_up(self) -> bool:
        return self.run("systemctl", "is-system-running").out.strip() in ("running", "degraded")

    def inside(self, *words: str, only: str = "muinpC") -> list[str]:
        """Return the words of a host command that runs `words` inside the container.

        `only` has a letter for each namespace of the container that the program enters.
        """
        return ["nsenter", "-t", str(self.leader), *(f"-{kind}" for kind in only), "--", *words]

    def run(self, *words: str) -> Ran:
        """Run a program in the container to its end, and return its result."""
        done = subprocess.run(self.inside(*words), capture_output=True, text=True, timeout=180)
        return Ran(done.returncode, done.stdout, done.stderr)

    def types(self, command: str, where: str = f"{HOME}/src") -> Ran:
        """Run a shell command exactly as a page gives it. Fail if it fails.

        Its directory is by default the clone in the container.
        """
        here = f"cd {where} && export PATH=$PATH:{VERSIONS}/current/bin"
        ran = self.run("sh", "-c", f"{here} && {command}")
        assert ran.code == 0, f"{command}\n{ran.out}\n{ran.err}"
        return ran

    def path(self, name: str) -> Path:
        """Return the host's path of a file in the container."""
        return Path(f"/proc/{self.leader}/root{name}")

    def write(self, name: str, text: str, mode: int = 0o644) -> None:
        """Write a file in the container."""
        path = self.path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(mode)

    # the program and its unit

    def install(self) -> None:
        """Install the files that an administrator installs.

        A `.pth` file makes acsard and its packages importable.
        """
        version = "python{}.{}".format(*OURS)
        packages = f"{HOME}/venv/lib/{version}/site-packages"
        python = f"{HOME}/venv/bin/python"
        home = "/usr/bin" if OURS in SUITES else f"{LENT}/bin"
        self.write(f"{HOME}/venv/pyvenv.cfg", f"home = {home}\n")
        self.write(f"{packages}/acsard.pth", f"{HOME}/src\n{HOME}/packages\n")
        self.write(
            f"{HOME}/venv/bin/acsard",
            f"#!{python}\nfrom acsard.cli import entry\n\nentry()\n",
            0o755,
        )
        self.path(python).symlink_to(f"{home}/{version}")
        self.write("/etc/ld.so.conf.d/acsard.conf", f"{LENT}/lib\n")
        self.run("ldconfig")
        self.write("/usr/local/bin/sudo", '#!/bin/sh\nexec "$@"\n', 0o755)
        self.install_unit()

    def install_unit(self) -> None:
        """Install the files of `acsard service install`, without starting the service.

        The version in use runs from the clone, because a copy takes long.
        """
        deploy = ROOT / "deploy" / "systemd"
        program = self.path(ACSARD).read_text()
        self.write(f"{VERSIONS}/test/bin/acsard", program, 0o755)
        self.write(f"{VERSIONS}/test/bin/acsard-stop", (deploy / "acsard-stop").read_text(), 0o755)
        self.path(f"{VERSIONS}/current").symlink_to("test")
        self.path(f"{VERSIONS}/test/lib/acsard").mkdir(parents=True)
        self.path(f"{VERSIONS}/test/lib/acsard/deploy").symlink_to(f"{HOME}/src/deploy")
        for unit in (UNIT, GATEWAY, PAGE):
            self.write(f"{UNITS}/{unit}", (deploy / unit).read_text())
        self.run("systemctl", "daemon-reload")

    def reset(self) -> None:
        """Restore the state in which the installation left the container."""
        self.run("systemctl", "stop", PAGE, GATEWAY, UNIT)
        for unit in (UNIT, GATEWAY, PAGE):
            shutil.rmtree(self.path(f"{UNITS}/{unit}.d"), ignore_errors=True)
        self.run("systemctl", "daemon-reload")
        self.run("systemctl", "reset-failed", UNIT, GATEWAY, PAGE)
        self.forget()
        self.write(CONFIG, USUAL)

    def forget(self) -> None:
        """Remove the latch files, so that the next start of the daemon is like its first one."""
        for file in self.path(f"{STATES}/acsard").glob("*.latches.*"):
            file.unlink()

    def drop_in(self, name: str, text: str, unit: str = UNIT) -> None:
        """Write a file in a unit's drop-in directory."""
        self.write(f"{UNITS}/{unit}.d/{name}", text)
        self.run("systemctl", "daemon-reload")

    def start(self, unit: str = UNIT) -> Ran:
        """Start a unit; return when it is ready or has failed."""
        return self.run("systemctl", "start", unit)

    def show(self, name: str, unit: str = UNIT) -> str:
        """Return a property of a unit."""
        return self.run("systemctl", "show", "--value", "-p", name, unit).out.strip()

    def main_pid(self, unit: str = UNIT) -> int:
        """Return a unit's process id on the host."""
        procs = self._cgroup / "payload" / "system.slice" / unit / "cgroup.procs"
        return int(procs.read_text().split()[0])

    def waited(self) -> float:
        """Return how long processes in the container have waited for a processor, s.

        The container's systemd is an ordinary process, so other work of this machine delays it.
        """
        try:
            some = (self._cgroup / "cpu.pressure").read_text().splitlines()[0]
        except OSError:
            return 0.0  # the kernel does not count it
        return int(some.rpartition("total=")[2]) / 1e6

    def fetch(self, path: str, *post: str) -> str:
        """Return the page's answer to a client in the container. With `post` it is a POST."""
        return self.run("python3", "-c", _FETCH, f"http://127.0.0.1:8080{path}", *post).out

    def journal(self) -> list[dict[str, Any]]:
        """Return the log of the unit's current or last run."""
        self.run("journalctl", "--sync")
        words = ["journalctl", "-o", "json", f"_SYSTEMD_INVOCATION_ID={self.show('InvocationID')}"]
        return [json.loads(line) for line in self.run(*words).out.splitlines()]

    def messages(self, unit: str = UNIT) -> str:
        """Return everything that was ever logged about a unit."""
        self.run("journalctl", "--sync")
        return self.run("journalctl", "-o", "cat", "-u", unit).out

    def is_active_again(self, restarts: int) -> None:
        """Wait until the unit is active and has been restarted more than `restarts` times."""
        until(
            lambda: self.show("ActiveState") == "active" and int(self.show("NRestarts")) > restarts,
            10.0,
            "the unit runs again",
        )


# The container has no curl.
_FETCH = """\
import sys
from urllib.error import HTTPError
from urllib.request import Request, urlopen

try:
    answer = urlopen(Request(sys.argv[1], *(b"" for _ in sys.argv[2:])))
except HTTPError as refused:
    answer = refused
print(answer.read().decode())
"""


class Board(FarPeer):
    """A simulated board at the container's serial port. It lies while the file `LIES` exists."""

    def __init__(self, container: Container) -> None:
        self._heard = []
        container.path(PORT).unlink(missing_ok=True)
        words = container.inside("python3", "-c", FAR, PORT, LIES, only="mnC")
        Program.__init__(self, words, "/")


_DRIVER = """\
import json, sys, threading, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect", json.dumps({
    "endpoints": ["tcp/127.0.0.1:7448"], "timeout_ms": -1, "exit_on_failure": False,
    "retry": {"period_init_ms": 50, "period_max_ms": 100, "period_increase_factor": 1},
}))
speed, patrols, sequence = 0.0, False, 0

def listen():
    global speed, patrols
    for line in sys.stdin:
        speed, patrols = float(line.split()[0]), "patrols" in line

def show(sample):
    state = json.loads(sample.payload.to_bytes()) if "json" in str(sample.encoding) else None
    if state is None:
        import msgspec
        state = msgspec.msgpack.decode(sample.payload.to_bytes())
    print(repr(time.monotonic()), state["mode"], flush=True)

threading.Thread(target=listen, daemon=True).start()
session = zenoh.open(config)
keep = session.declare_subscriber("acsard/acsar/state", show)
while True:
    now = 0.0 if patrols and time.monotonic() % 1.0 < 0.3 else speed
    sequence += 1
    signature = {"sender": "patrol", "stamp": time.monotonic_ns(), "sequence": sequence}
    session.put(
        "acsard/acsar/cmd/app",
        json.dumps({"linear": {"x": now}, "angular": {"z": 0.0}}),
        attachment=json.dumps(signature if patrols else {"sender": "driver"}),
    )
    time.sleep(0.05)
"""


class Driver(Program):
    """A client of the bus in the container's network, which sends a speed at 20 Hz."""

    def __init__(self, container: Container) -> None:
        words = container.inside(sys.executable, "-c", _DRIVER, only="n")
        super().__init__(words, "/", stdin=subprocess.PIPE)

    def sends(self, speed: float) -> None:
        """Send this speed from now on."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{speed}\n".encode())
        self.process.stdin.flush()

    def patrols(self, speed: float = 0.3) -> None:
        """Send zeros for 0.3 s every second, and this speed in between, under its own sender id."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{speed} patrols\n".encode())
        self.process.stdin.flush()

    def states(self, after: float) -> list[tuple[float, str]]:
        """Return the time and the mode of each state after this time."""
        rows = [line.split(" ", 1) for line in list(self.out)]
        return [(float(at), mode) for at, mode in rows if float(at) > after]

    def drives(self, board: Board, speed: float = 0.5) -> None:
        """Send zeros until the daemon obeys them, then the speed until the wheels reach it."""
        self.sends(0.0)
        began = time.monotonic()
        obeyed = until(
            lambda: next((at for at, mode in self.states(began) if mode == "driving"), None),
            10.0,
            "zeros are obeyed",
        )
        self.sends(speed)
        board.awaits(f"ap{speed / 0.05:05.2f}".encode(), after=obeyed)
