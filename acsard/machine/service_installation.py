"""Installs acsard as a systemd service, or removes the service.

The files come from `deploy/`. A file that a user has changed goes only with `force` or `purge`.
Both are lists of steps, which the user can read before.
"""

from __future__ import annotations

import grp
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Container, Iterable, Mapping
from pathlib import Path

from msgspec import Struct

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
            f"`groupadd --system {group}`, or see deploy/systemd/README.md for another group"
        )
    return ""


class File(Struct, frozen=True):
    path: Path
    content: bytes
    mode: int = 0o644
    kept: bool = False  # users change it: never replaced, and if changed, removed only by a purge

    def current_content(self) -> bytes | None:
        """Return the content, or None if there is no file. Raises `MendableError`."""
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unreadable(self.path, error) from None

    def is_as_written(self) -> bool:
        """Return whether mode and owner are right, or the user's affair. Raises `OSError`."""
        status = self.path.lstat()
        if self.kept or stat.S_ISLNK(status.st_mode):
            return True
        return (stat.S_IMODE(status.st_mode), status.st_uid) == (self.mode, 0)

    def condition(self) -> str:
        """Return "missing", "as installed", "changed", "wrong mode or owner" or "unreadable"."""
        try:
            content = self.current_content()
        except MendableError:
            return "unreadable"
        if content is None:
            return "missing"
        if content != self.content:
            return "changed"
        return "as installed" if self.is_as_written() else WRONG_MODE


WRONG_MODE = "wrong mode or owner"


class Write(Struct, frozen=True):
    """Writes a file, for the reason `why`."""

    file: File
    why: str = ""

    def __str__(self) -> str:
        why = f"; {self.why}" if self.why else ""
        size, mode = len(self.file.content), self.file.mode
        return f"write   {self.file.path}  ({size} bytes, mode {mode:o}{why})"

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
        # acsard's own directories are deleted when they become empty.
        if self._is_directory:
            shutil.rmtree(self.path)
        else:
            self.path.unlink()
        for place in self.path.parents:
            if place.name not in OWN_DIRECTORIES:
                return
            try:
                place.rmdir()
            except OSError:
                # The directory still contains other files.
                return


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
        # Raises `MendableError` with the command's error output.
        try:
            done = run_command(self.words, 60.0)
            code = done.returncode
            failed = (done.stderr.strip() or how_it_ended(code)) if code else ""
        except (OSError, subprocess.TimeoutExpired) as error:
            failed = str(error)
        if failed and not self.may_fail:
            raise MendableError(f"{' '.join(self.words)}: {failed}")


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
# Removed when they become empty.
OWN_DIRECTORIES = ("acsard", *(f"{unit}.d" for unit in ALL_UNITS))
UNIT_DIRECTORY, PACKAGE_UNIT_DIRECTORY = (
    Path("/etc/systemd/system"),
    Path("/usr/lib/systemd/system"),
)
RULES = Path("/etc/udev/rules.d/70-acsar.rules")
CONFIG_DIRECTORY = Path("/etc/acsard")
LAN_DROP_IN = "lan.conf"
COMMAND = Path("/usr/local/bin/acsard")  # in the PATH of every user, also under sudo
PROGRAM = versions.HOME / versions.CURRENT / "bin" / "acsard"
TLS_DIRECTORY = "/etc/acsard/tls"  # in the drop-in `lan.conf`
# Directories by unit, with their content.
STATE_DIRECTORIES = {
    UNIT: (
        Path("/var/lib/acsard"),
        "the daemon's recordings, and the stop that survives a restart",
    ),
    PAGE: (Path("/var/lib/acsard-web"), "invitations to the page"),
}

Found = Mapping[Path, bytes | None]  # by path; None without a file

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


def lan_drop_in(unit: str) -> File:
    """Return the drop-in `lan.conf`: local network and certificates for a unit."""
    return File(
        UNIT_DIRECTORY / f"{unit}.d" / LAN_DROP_IN,
        (source() / "systemd" / LAN_DROP_IN).read_bytes(),
    )


def admitting(directory: Path) -> Write | Keep | None:
    """Return the step that lets the service's TLS gateway use these certificates.

    Its drop-in permits more than loopback, and root's files. Of an existing one only the paths
    change: the user may have restricted the networks. Return None without the service or root.
    """
    units = [place / GATEWAY for place in (UNIT_DIRECTORY, PACKAGE_UNIT_DIRECTORY)]
    if os.geteuid() != 0 or not any(unit.exists() for unit in units):
        return None
    file = lan_drop_in(GATEWAY)
    return admitted(file, file.current_content(), directory)


def admitted(file: File, content: bytes | None, directory: Path) -> Write | Keep:
    """Return the step that writes the directory of certificates into a drop-in, if needed."""
    place = str(directory).encode()
    text = re.sub(
        rb'(?m)^(LoadCredential=[\w.-]+:|ExecReload=.*cd ")[^"\n]*(/[^/"\n]+|" && .*)$',
        lambda match: match[1] + place + match[2],
        file.content if content is None else content,
    )
    if text == content:
        return Keep(file.path, "it already names the directory of the certificates")
    return Write(File(file.path, text))


def present(wanted: Iterable[File]) -> dict[Path, bytes | None]:
    """Return the present contents by path. Raises `MendableError`."""
    return {file.path: file.current_content() for file in wanted}


def wrong_modes(wanted: Iterable[File]) -> set[Path]:
    """Return the paths of the existing files in `wanted` whose mode or owner is wrong."""
    return {file.path for file in wanted if file.path.exists() and not file.is_as_written()}


def installing(
    wanted: Iterable[File], contents: Found, wrong: Container[Path], *, force: bool
) -> list[Step]:
    """Return the steps that install the service, with files in `wrong` modes again.

    Files with `kept` stay. Others that differ are overwritten by `force`, or raise `MendableError`.
    """
    steps: list[Step] = []
    changed: list[str] = []
    for file in wanted:
        there = contents[file.path]
        same = there == file.content
        if (same and file.path not in wrong) or (file.kept and there is not None):
            steps.append(Keep(file.path))
            continue
        if there is not None and not same:
            changed.append(str(file.path))
        steps.append(Write(file, f"it has a {WRONG_MODE}" if same else ""))
    if changed and not force:
        paths = ", ".join(changed)
        raise MendableError(
            "these files differ from the files that this version of acsard installs: "
            f"{paths}; look at the differences, and replace the files with --force"
        )
    return [InstallCopy(), *steps, *INSTALL_COMMANDS]


def linking() -> list[Step]:
    """Return the step that puts `acsard` into the PATH, unless there is one."""
    return [] if os.path.lexists(COMMAND) else [Link(COMMAND, PROGRAM)]


def config_directories() -> list[Path]:
    """Return the directories of the service in /etc, which may also contain the user's files."""
    return [*(UNIT_DIRECTORY / f"{unit}.d" for unit in reversed(ALL_UNITS)), CONFIG_DIRECTORY]


def foreign_entries(files: Iterable[File], places: Iterable[Path]) -> list[Path]:
    """Return the entries of the directories `places` that are not files of the installation."""
    ours = {file.path for file in files}
    inside = (path for place in places if place.is_dir() for path in sorted(place.iterdir()))
    return [path for path in inside if path not in ours]


def uninstalling(
    wanted: Iterable[File],
    contents: Found,
    others: Iterable[Path] = (),
    *,
    force: bool,
    purge: bool = False,
    stateful: Iterable[str] = (),
    programs: Iterable[Path] = (),
) -> list[Step]:
    """Return the steps that remove the service, with a `Keep` for all that stays.

    Changed files go with `force`, unless they are `kept`. `purge` removes everything, with `others`
    and the directories of `stateful` units, which it may have to install again: only systemd can
    remove them.
    """
    wanted, stateful = list(wanted), list(stateful)
    # Only systemd knows the real path of a state directory, and only while the unit is installed.
    # So if an earlier removal has kept the directory without its unit, install the unit again.
    again = [
        file
        for file in wanted
        if purge and file.path.name in stateful and contents[file.path] is None
    ]
    there = [file for file in wanted if contents[file.path] is not None or file in again]
    why: dict[Path, str] = {}
    for file in there:
        if contents[file.path] == file.content or purge:
            continue
        if file.kept:
            why[file.path] = "it is your configuration; --purge removes it"
        elif not force:
            why[file.path] = "the file differs from what this version installs; --force removes it"
    steps: list[Step] = [
        Keep(file.path, why[file.path]) if file.path in why else Remove(file.path) for file in there
    ]
    for path in others:
        what = (
            "certificates and their authority"
            if path == Path(TLS_DIRECTORY)
            else "not a file of the service"
        )
        steps.append(Remove(path) if purge else Keep(path, f"{what}; --purge removes it"))
    for unit in stateful:
        where, what = STATE_DIRECTORIES[unit]
        clean = Run(("systemctl", "clean", "--what=state", unit))
        steps.insert(0, clean if purge else Keep(where, f"{what}; --purge removes it"))
    units = [name for name in reversed(ALL_UNITS) if any(file.path.name == name for file in there)]
    leaving = [Run(("systemctl", "disable", "--now", *units))] if units else []
    back: list[Step] = [*map(Write, again), RELOAD_COMMANDS[0]] if again else []
    removed: list[Step] = []
    for path in programs:
        # If a unit stays, the daemon may start again, and needs its program and `acsard-stop`.
        stays = [file.name for file in why if file.name in ALL_UNITS]
        removed.append(
            Keep(path, f"{stays[0]} stays and needs this directory") if stays else Remove(path)
        )
    return [*back, *leaving, *steps, *REMOVE_COMMANDS, *removed]


def programs() -> list[Path]:
    """Return the copies and links that the installation has made."""
    links = (versions.CURRENT, versions.PREVIOUS)
    return [
        *([COMMAND] if COMMAND.is_symlink() and COMMAND.readlink() == PROGRAM else ()),
        *(versions.HOME / name for name in links if (versions.HOME / name).is_symlink()),
        *(versions.HOME / name for name in versions.installed()),
    ]


def state(unit: str) -> str:
    """Return a unit's state as lines `NAME=value`, systemctl's error text, or ""."""
    about = "--property=ActiveState,SubState,StatusText,NRestarts"
    try:
        done = run_command(("systemctl", "show", unit, about), 10.0)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() or done.stderr.strip()
