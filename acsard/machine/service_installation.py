"""Installs acsard as a systemd service, or removes the service.

The files come from `deploy/`. Both are lists of steps, which the user can read before. What stays
after a removal, and what a purge removes, is the same as for the Debian package.
"""

from __future__ import annotations

import grp
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from msgspec import Struct

from acsard.core.values import Seconds
from acsard.host.atomic_file import replace
from acsard.host.child import how_it_ended
from acsard.host.errors import MendableError, NotPermittedError
from acsard.host.processes import run_command
from acsard.host.version import version
from acsard.machine import versions
from acsard.machine.deploy_files import reference, source

# Group of the service in its unit, and the program that runs `acsard-stop`.
GROUP, SETPRIV = "dialout", "/usr/bin/setpriv"


def missing_prerequisite(group: str = GROUP, program: str = SETPRIV) -> str:
    """Return an error text if the service's group or a program is missing, or ""."""
    if not os.access(program, os.X_OK):
        return (
            f"{program} is missing, but the service needs it to stop the wheels after the daemon's "
            "end; install the package util-linux"
        )
    try:
        grp.getgrnam(group)
    except KeyError:
        return (
            f"this system has no group {group}, which lets the service use the serial port; run "
            f"`groupadd --system {group}`; page howto/install of the manual has another group"
        )
    return ""


class File(Struct, frozen=True):
    path: Path
    content: bytes
    mode: int = 0o644
    kept: bool = False  # users change it: never replaced

    def current_content(self) -> bytes | None:
        """Return the content, or None if there is no file. Raises `MendableError`."""
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unreadable(self.path, error) from None

    def condition(self) -> str:
        """Return "missing", "as installed", "changed" or "unreadable"."""
        try:
            content = self.current_content()
        except MendableError:
            return "unreadable"
        if content is None:
            return "missing"
        return "as installed" if content == self.content else "changed"


class Write(Struct, frozen=True):
    """Writes a file with its mode, owned by this user."""

    file: File

    def __str__(self) -> str:
        size, mode = len(self.file.content), self.file.mode
        return f"write   {self.file.path}  ({size} bytes, mode {mode:o})"

    def do(self) -> None:
        # Every user may enter new directories.
        path = self.file.path
        made = [place for place in path.parents if not place.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        for place in made:
            place.chmod(0o755)
        # If the path is a symbolic link, replace the link and not the file to which it points.
        replace(path, self.file.content, mode=self.file.mode, owner=(os.geteuid(), os.getegid()))


class Remove(Struct, frozen=True):
    """Deletes a file, or a directory with everything in it."""

    path: Path

    def __str__(self) -> str:
        return f"remove  {self.path}" + ("/ and everything in it" if self._is_directory else "")

    @property
    def _is_directory(self) -> bool:
        return self.path.is_dir() and not self.path.is_symlink()

    def do(self) -> None:
        if self._is_directory:
            shutil.rmtree(self.path)
        else:
            self.path.unlink()


class Keep(Struct, frozen=True):
    """Leaves a file or directory as it is, for the reason `why`."""

    path: Path
    why: str = ""

    def __str__(self) -> str:
        return f"keep    {self.path}" + (f"  ({self.why})" if self.why else "")

    def do(self) -> None: ...


class Run(Struct, frozen=True):
    words: tuple[str, ...]
    may_fail: bool = False  # does not matter, for example on a system without udev

    def __str__(self) -> str:
        return f"run     {' '.join(self.words)}"

    def do(self) -> None:
        try:
            ran(self.words, 60.0)
        except MendableError:
            if not self.may_fail:
                raise


def ran(words: tuple[str, ...], within_s: Seconds) -> str:
    """Run a command and return its output. Raises `MendableError` with its error output."""
    try:
        done = run_command(words, within_s)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise MendableError(f"{' '.join(words)}: {error}") from None
    if done.returncode:
        why = done.stderr.strip() or how_it_ended(done.returncode)
        raise MendableError(f"{' '.join(words)}: {why}")
    return done.stdout


class InstallCopy(Struct, frozen=True):
    """Copies acsard from this environment to /opt/acsard, and makes the copy the version in use."""

    def __str__(self) -> str:
        return f"copy    acsard from {sys.prefix} to {versions.HOME}/{version()}"

    def do(self) -> None:
        versions.make_home()
        with versions.changing():
            versions.use(versions.copy())


class Link(Struct, frozen=True):
    """Makes a symbolic link."""

    path: Path
    target: Path

    def __str__(self) -> str:
        return f"link    {self.path} -> {self.target}"

    def do(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.symlink_to(self.target)


Step = Write | Remove | Keep | Run | InstallCopy | Link


def _unreadable(path: Path, error: OSError) -> MendableError:
    if isinstance(error, PermissionError):
        return NotPermittedError(f"no permission to read {path}; run this command with sudo")
    return MendableError(f"cannot read {path}: {error.strerror}; check the file")


UNIT, GATEWAY, PAGE = "acsard.service", "acsard-gateway.service", "acsard-web.service"
ALL_UNITS = (UNIT, GATEWAY, PAGE)
UNIT_DIRECTORY, PACKAGE_UNIT_DIRECTORY = (
    Path("/etc/systemd/system"),
    Path("/usr/lib/systemd/system"),
)
RULES = Path("/etc/udev/rules.d/70-acsar.rules")
CONFIG_DIRECTORY = Path("/etc/acsard")
COMMAND = Path("/usr/local/bin/acsard")  # in the PATH of every user, also under sudo
PROGRAM = versions.HOME / versions.CURRENT / "bin" / "acsard"
TLS_DIRECTORY = "/etc/acsard/tls"  # in the drop-in `lan.conf`
# What a user may miss, with its content.
KEPT_BY_REMOVAL = {
    CONFIG_DIRECTORY: "your configuration and certificates",
    **{UNIT_DIRECTORY / f"{unit}.d": "your drop-ins" for unit in ALL_UNITS},
    Path("/var/lib/acsard"): "recordings, and the stop that survives a restart",
    Path("/var/lib/acsard-web"): "invitations to the page",
}
# What the directories of the state of a service with a dynamic user are links to.
PRIVATE = Path("/var/lib/private/acsard"), Path("/var/lib/private/acsard-web")

RELOAD_COMMANDS = (
    Run(("systemctl", "daemon-reload")),
    Run(("udevadm", "control", "--reload"), may_fail=True),
)
INSTALL_COMMANDS = (
    *RELOAD_COMMANDS,
    # Apply the new udev rules to the devices that are plugged in.
    Run(
        ("udevadm", "trigger", *(f"--subsystem-match={k}" for k in ("tty", "usb-serial", "misc"))),
        may_fail=True,
    ),
    # Start the daemon first, because the page's unit mounts a directory that systemd creates when
    # the daemon starts. A failure is ignored, because the next command starts the daemon again.
    Run(("systemctl", "start", UNIT), may_fail=True),
    Run(("systemctl", "enable", "--now", *ALL_UNITS)),
)
REMOVE_COMMANDS = (*RELOAD_COMMANDS, Run(("systemctl", "reset-failed", *ALL_UNITS), may_fail=True))


def files() -> list[File]:
    """Return all files that the installation of the service writes."""
    defaults, simulator = reference(source()).read_text(encoding="utf-8"), '\nport = "sim"'
    # Without this line, the installed service would run the simulator.
    assert defaults.count(simulator) == 1
    return [
        *system_files(source()),
        File(
            CONFIG_DIRECTORY / "acsard.toml",
            defaults.replace(simulator, '\nport = "/dev/acsar"').encode(),
            kept=True,
        ),
    ]


def system_files(deploy: Path) -> list[File]:
    """Return the files that belong to the version with this `deploy/`."""
    return [
        *(
            File(UNIT_DIRECTORY / name, (deploy / "systemd" / name).read_bytes())
            for name in ALL_UNITS
        ),
        File(RULES, (deploy / "udev" / RULES.name).read_bytes()),
    ]


def admitting(directory: Path) -> Write | None:
    """Return the step that lets the service's TLS gateway use the certificates in a directory.

    Its drop-in `lan.conf` permits more than loopback, and root's files in `TLS_DIRECTORY`. One that
    is there stays: the user may have restricted the networks.
    """
    place = UNIT_DIRECTORY / f"{GATEWAY}.d" / "lan.conf"
    units = [there / GATEWAY for there in (UNIT_DIRECTORY, PACKAGE_UNIT_DIRECTORY)]
    served = os.geteuid() == 0 and any(unit.exists() for unit in units)
    if not served or place.exists() or directory != Path(TLS_DIRECTORY):
        return None
    return Write(File(place, (source() / "systemd" / "lan.conf").read_bytes()))


def installing(wanted: Iterable[File], *, force: bool) -> list[Step]:
    """Return the steps that install the service. The first configuration is never replaced.

    Raises `MendableError` if another file differs, unless `force` overwrites it.
    """
    there = {file: file.current_content() for file in wanted}
    changed = [
        str(file.path)
        for file, content in there.items()
        if content not in (None, file.content) and not file.kept
    ]
    if changed and not force:
        raise MendableError(
            "these files differ from the files that this version of acsard installs: "
            f"{', '.join(changed)}; look at the differences, and replace the files with --force"
        )
    steps: list[Step] = [
        Keep(file.path) if file.kept and content is not None else Write(file)
        for file, content in there.items()
    ]
    return [InstallCopy(), *steps, *INSTALL_COMMANDS]


def linking() -> list[Step]:
    """Return the step that puts `acsard` into the PATH, unless there is one."""
    return [] if os.path.lexists(COMMAND) else [Link(COMMAND, PROGRAM)]


def uninstalling(*, purge: bool) -> list[Step]:
    """Return the steps that remove the service, with a `Keep` for all that only `purge` removes."""
    units = [unit for unit in reversed(ALL_UNITS) if (UNIT_DIRECTORY / unit).exists()]
    steps: list[Step] = [Run(("systemctl", "disable", "--now", *units))] if units else []
    steps += [Remove(path) for path in (*(UNIT_DIRECTORY / unit for unit in units), RULES)]
    if purge:
        steps += map(Remove, (*KEPT_BY_REMOVAL, *PRIVATE))
    else:
        steps += [
            Keep(path, f"{what}; --purge removes it") for path, what in KEPT_BY_REMOVAL.items()
        ]
    programs = [COMMAND] if COMMAND.is_symlink() and COMMAND.readlink() == PROGRAM else []
    steps += [*REMOVE_COMMANDS, *map(Remove, (*programs, versions.HOME))]
    return [
        step for step in steps if not isinstance(step, Keep | Remove) or os.path.lexists(step.path)
    ]


def state(unit: str) -> str:
    """Return a unit's state as lines `NAME=value`, or why systemd does not say it."""
    about = "--property=ActiveState,SubState,StatusText,NRestarts"
    try:
        return ran(("systemctl", "show", unit, about), 10.0).strip()
    except MendableError as error:
        return str(error)
