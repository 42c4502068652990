"""Changes the version that the service runs, watches the new one, and goes back if it fails.

The change is one step (`versions.use`) while the robot stands. The daemon's latch file, settings,
tokens, certificates and recordings are not touched. If this program is killed after the change, the
new version stays in use.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
from msgspec import Struct, field

from acsard.bus.address import Address, address_of
from acsard.bus.zenoh_sessions import answers
from acsard.client.connection import open_connection
from acsard.core.config.parsing import ConfigError, parse
from acsard.core.config.settings import Config
from acsard.core.messages.diagnostics import MAX_MISSED_FRACTION
from acsard.core.messages.schema import RobotState
from acsard.core.values import AcsardError, Seconds
from acsard.host.config_file import read
from acsard.host.errors import MendableError
from acsard.host.processes import config_of
from acsard.machine import service_installation as service
from acsard.machine import versions
from acsard.machine.service_installation import ALL_UNITS, RELOAD_COMMANDS, UNIT, Run, Write, ran

WATCH_S = 30.0
WAIT_S = 60.0  # until the robot stands
STANDING_S = 2.0  # a pause of a robot that drives is shorter
STANDING_WHEEL_SPEED = 0.1  # rad/s: 5 mm/s with a wheel of 10 cm
BACK_TIMEOUT_S = 10.0  # until the version before runs again
COPY_TIMEOUT_S = 600.0  # an SD card writes 200 MB in a minute

Say = Callable[[str], None]


# The new version beside the old one


def prepare(what: Path) -> str:
    """Return the name of the version in a .deb, an environment or /opt/acsard, and install it.

    Raises `MendableError`, and leaves the version in use as it is.
    """
    if what.parent == versions.HOME and what.name in versions.installed():
        return what.name
    if what.is_file():
        return _from_package(what)
    python = what / "bin" / "python"
    if not python.exists():
        raise MendableError(
            f"{what} is neither a .deb nor an environment with bin/python; name the package, or "
            "the directory of the venv, uv tool or pipx into which the new version was installed"
        )
    # The new version makes its own copy. With -B no bytecode of root gets into the environment.
    copying = (str(python), "-I", "-B", "-m", "acsard.machine.versions")
    return ran(copying, COPY_TIMEOUT_S).split()[-1]


def _from_package(file: Path) -> str:
    name = ran(("dpkg-deb", "--field", str(file), "Package"), 60.0).strip()
    if name != "acsard":
        raise MendableError(f"{file} is the package {name}; name a package of acsard")
    # apt checks before it unpacks that this system has the Python that the package needs.
    installing = ("env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "install", "--yes", "--quiet")
    # Without a terminal of its own, dpkg writes its errors to stderr.
    options = ("--allow-downgrades", "--option=Dpkg::Use-Pty=0")
    ran((*installing, *options, str(file.absolute())), COPY_TIMEOUT_S)
    listed = ran(("dpkg-query", "--listfiles", name), 60.0)
    found = re.search(rf"(?m)^{versions.HOME / versions.PACKAGE}/([^/\n]+)$", listed)
    version = found[1] if found else ""
    if version not in versions.installed():
        raise MendableError(f"{file} was installed, but has no version of acsard; build it again")
    # The package never replaces the version in use.
    packaged = versions.HOME / versions.PACKAGE / version
    if not versions.same(packaged, versions.HOME / version):
        raise MendableError(
            f"version {version} of another build is in use already; change to another version "
            "first, or build the package again from a commit"
        )
    return version


# The service and its robot


class Look(Struct, frozen=True):
    """The daemon as a client sees it."""

    state: RobotState
    commanded: bool  # it sends speeds other than zero

    @property
    def stands(self) -> bool:
        speeds = map(abs, self.state.wheels)
        return not self.commanded and max(speeds, default=0.0) < STANDING_WHEEL_SPEED

    @property
    def missed_fraction(self) -> float:
        counters = self.state.counters
        return counters.get("missed_periods", 0) / max(1, counters.get("lines_sent", 0))


def look(address: Address) -> Look | None:
    """Return what the daemon answers, or None."""
    if not answers(address.endpoint):
        return None
    try:
        with open_connection(address) as robot:
            sent = robot.get("cmd_vel_out").twist
            return Look(robot.get("state"), bool(sent.linear.x or sent.angular.z))
    except AcsardError:
        return None


class UnitState(Struct, frozen=True, rename="pascal"):
    """A unit as `systemctl show` describes it."""

    active_state: str
    n_restarts: int
    pid: int = field(name="MainPID")
    job: str = ""  # systemd is about to stop or start it

    @property
    def runs(self) -> bool:
        return self.active_state in ("active", "activating", "reloading", "deactivating")


def unit_state(unit: str) -> UnitState:
    properties = ",".join(one.encode_name for one in msgspec.structs.fields(UnitState))
    shown = ran(("systemctl", "show", unit, f"--property={properties}"), 10.0)
    values = dict(line.split("=", 1) for line in shown.splitlines())
    return msgspec.convert(values, UnitState, strict=False)


def _address(file: Path) -> Address:
    # A file that only the new version understands does not describe the daemon that runs.
    try:
        return address_of(parse(read(file)))
    except (OSError, ConfigError):
        return address_of(Config())


def _stands(address: Address, wait_s: Seconds) -> Look:
    # Raises `MendableError`, also without an answer.
    end_s = time.monotonic() + wait_s
    since_s = None
    while True:
        seen, now_s = look(address), time.monotonic()
        if seen is None:
            raise MendableError(
                f"the service runs, but does not answer at {address.endpoint}, so nobody knows "
                "whether the robot stands; see `systemctl status acsard`, or stop the service with "
                "`systemctl stop acsard` and run the command again"
            )
        if not seen.stands:
            since_s = None
            if now_s > end_s:
                raise MendableError(
                    f"the robot drives ({seen.state.reason}); stop it and run the command again, "
                    "or let the command wait longer with --wait SECONDS"
                )
        elif since_s is None:
            since_s = now_s
        elif now_s - since_s >= STANDING_S:
            return seen
        time.sleep(0.2)


# The change


def change(name: str, say: Say, wait_s: Seconds = WAIT_S, watch_s: Seconds = WATCH_S) -> None:
    """Let the service run the version `name`. Raises `MendableError` if it stays or goes back."""
    before, older = versions.current(), versions.previous()
    if name == before:
        say(f"version {name} is in use already")
        return
    daemon = unit_state(UNIT)
    file = config_of(daemon.pid) or service.CONFIG_DIRECTORY / "acsard.toml"
    if file.exists():
        checking = (str(versions.HOME / name / "bin" / "acsard"), "check", "--config", str(file))
        try:
            ran(checking, versions.CHECK_TIMEOUT_S)
        except MendableError as error:
            raise MendableError(
                f"version {before} stays in use, because {name} refuses the configuration: {error}"
            ) from None
        say(f"version {name} accepts {file}")
    address, seen = _address(file), None
    if daemon.active_state == "active":
        say(f"waiting until the robot stands, at most {wait_s:g} s")
        seen = _stands(address, wait_s)
    running = [unit for unit in ALL_UNITS if unit_state(unit).runs]
    versions.use(name)
    trouble = ""
    try:
        _start(before, name, running, say)
    except (OSError, MendableError) as error:
        trouble = f"cannot be started ({error})"
    if not trouble and UNIT not in running:
        say(f"version {name} is in use. The service does not run: `sudo systemctl start acsard`")
        return
    if not trouble:
        say(f"version {name} is in use; watching it for {watch_s:g} s")
        trouble = watch(address, seen, running, watch_s)
    if trouble:
        versions.go_back(before, older)
        back = f"version {before} is in use again"
        try:
            _start(name, before, running, say)
            if UNIT in running:
                back = _came_back(before)
        except (OSError, MendableError) as error:
            back += f", but cannot be started ({error})"
        raise MendableError(f"version {name} {trouble}; {back}. `journalctl -u acsard` has the log")
    versions.remove_others()
    say(f"version {name} works; `sudo acsard service rollback` goes back to {before}")


def _start(old: str, new: str, running: list[str], say: Say) -> None:
    # A unit may belong to the version, so each version brings its own. A file that differs from
    # the old version's has been changed by a user, and stays.
    for file, former in zip(*(map(_system_files, (new, old))), strict=True):
        there = file.current_content()
        if there not in (None, former.content, file.content):
            say(f"{file.path} differs from that of version {old}, and was kept")
        elif there != file.content:
            Write(file).do()
    for command in RELOAD_COMMANDS:
        command.do()
    if running:
        Run(("systemctl", "reset-failed", *running), may_fail=True).do()
        # A version that hangs would hold this command for long.
        Run(("systemctl", "restart", "--no-block", *running)).do()


def _system_files(name: str) -> list[service.File]:
    return service.system_files(versions.deploy_of(name))


def watch(address: Address, before: Look | None, running: list[str], watch_s: Seconds) -> str:
    """Return why the version that was just started does not work, in words, or ""."""
    end_s = time.monotonic() + watch_s
    while True:
        over = time.monotonic() >= end_s
        for unit in running:
            try:
                state = unit_state(unit)
            except MendableError as error:  # a version that takes all processor time does this
                return f"could not be watched ({error})"
            if state.n_restarts or state.active_state == "failed":
                return f"does not keep {unit} running"
            if state.active_state == "inactive" and not state.job and unit == UNIT:
                raise MendableError(
                    f"another program stopped {unit}, so the new version was not watched to the "
                    "end, and stays in use; `sudo acsard service rollback` goes back"
                )
            if over and state.active_state != "active":
                return f"has not started {unit} within {watch_s:g} s"
        if over:
            return worse(before, look(address))
        time.sleep(0.5)


def worse(before: Look | None, after: Look | None) -> str:
    if after is None:
        return "runs, but does not answer on the bus"
    if before is None:
        return ""
    if before.state.link == "up" != after.state.link:
        return f"has no link to the microcontroller ({after.state.link})"
    # A few late periods in half a minute are chance, so the bound is that of `acsard doctor`.
    if after.missed_fraction > max(before.missed_fraction, MAX_MISSED_FRACTION):
        missed = after.state.counters["missed_periods"]
        return f"missed {missed} control periods, more than the version before"
    return ""


def _came_back(name: str) -> str:
    end_s = time.monotonic() + BACK_TIMEOUT_S
    while unit_state(UNIT).active_state != "active":
        if time.monotonic() > end_s:
            return f"version {name} is in use again, but does not start either"
        time.sleep(0.1)
    return f"version {name} runs again"
