"""`acsard service install | uninstall | status`: acsard as a system service.

What it writes are the files of `deploy/`, with the path of this installation in the unit. Nothing
that somebody else wrote is overwritten or removed without --force.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from msgspec import Struct

from acsard.host.exits import Exit, ExitError

UNIT, STOP = "acsard.service", "acsard-stop"
DROP_IN = Path("/etc/systemd/system/acsard.service.d/lan.conf")
HOME = "/opt/acsard/venv"
"""Where the unit of `deploy/` believes acsard to be."""

INSTALLED = (
    ("systemctl", "daemon-reload"),
    ("udevadm", "control", "--reload"),
    (
        "udevadm",
        "trigger",
        "--subsystem-match=tty",
        "--subsystem-match=usb-serial",
        "--subsystem-match=misc",
    ),
    ("systemctl", "enable", "--now", UNIT),
)
LEAVING = (("systemctl", "disable", "--now", UNIT),)
GONE = (
    ("systemctl", "daemon-reload"),
    ("systemctl", "reset-failed", UNIT),
    ("udevadm", "control", "--reload"),
)
MAY_FAIL = {"reset-failed", "trigger", "control"}
"""A machine without udev, or a unit that never failed, is no reason to stop halfway."""


class File(Struct, frozen=True):
    """One file of the service."""

    path: Path
    content: bytes
    mode: int = 0o644
    kept: bool = False
    """The user's to change: never replaced, removed only while it is as it was written."""

    def found(self) -> bytes | None:
        """What is there now, None for nothing."""
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return None


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "service",
        help="install acsard as a system service, remove it, or see how it is",
        description="Install the unit, the stop script, the udev rules and a first "
        "configuration, enable and start the service; or undo that.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    for name, main, text in (
        ("install", main_install, "write the files, enable and start the service"),
        ("uninstall", main_uninstall, "stop and disable the service, remove the files"),
        ("status", main_status, "which files are there, does the service run"),
    ):
        action = actions.add_parser(name, help=text, description=text.capitalize() + ".")
        if name != "status":
            action.add_argument(
                "--dry-run", action="store_true", help="print every file and command; do nothing"
            )
            action.add_argument(
                "--force", action="store_true", help="also files that somebody has changed"
            )
        action.set_defaults(main=main)


def files() -> list[File]:
    """Every file of the service, as this installation writes it."""
    source = _source()
    unit = (source / "systemd" / UNIT).read_text(encoding="utf-8").replace(HOME, sys.prefix)
    reference = _reference(source).read_text(encoding="utf-8")
    return [
        File(Path("/etc/systemd/system") / UNIT, unit.encode()),
        File(
            Path("/opt/acsard/bin/acsard-stop"),
            (source / "systemd" / "acsard-stop").read_bytes(),
            0o755,
        ),
        File(
            Path("/etc/udev/rules.d/70-acsar.rules"),
            (source / "udev" / "70-acsar.rules").read_bytes(),
        ),
        File(
            Path("/etc/acsard/acsard.toml"),
            reference.replace('port = "sim"', 'port = "/dev/acsar"').encode(),
            kept=True,
        ),
    ]


def main_install(args: argparse.Namespace) -> int:
    """Write, reload, enable, start."""
    _ready(args)
    wanted = files()
    if sys.prefix == sys.base_prefix or sys.prefix.startswith(("/home/", "/root", "/tmp/")):
        print(
            f"acsard: {sys.prefix} is no place for a service, which cannot see homes and /tmp; "
            f"install acsard in a venv at {HOME} (README, As a service)",
            file=sys.stderr,
        )
        if not (args.dry_run or args.force):
            return int(Exit.FAILURE)
    changed = [f for f in wanted if not f.kept and f.found() not in (None, f.content)]
    if changed and not args.force:
        paths = ", ".join(str(file.path) for file in changed)
        raise ExitError(Exit.FAILURE, f"would overwrite {paths}; look at them, or use --force")
    for file in wanted:
        if file.found() == file.content or (file.kept and file.found() is not None):
            print(f"keep    {file.path}")
            continue
        print(f"write   {file.path}  ({len(file.content)} bytes, mode {file.mode:o})")
        if not args.dry_run:
            put(file)
    _run(INSTALLED, args.dry_run)
    if not args.dry_run:
        print("\nnow set [mcu] and [robot] in /etc/acsard/acsard.toml, then:")
        print("systemctl restart acsard && acsard doctor --config /etc/acsard/acsard.toml")
    return 0


def put(file: File) -> None:
    """Write it, with directories that the service's own user can enter whatever the umask."""
    made = [place for place in file.path.parents if not place.exists()]
    file.path.parent.mkdir(parents=True, exist_ok=True)
    for place in made:
        place.chmod(0o755)
    file.path.unlink(missing_ok=True)  # a link is replaced, not written through
    file.path.write_bytes(file.content)
    file.path.chmod(file.mode)


def lan_drop_in() -> File:
    """What lets the unit onto the local network and gives it its certificates."""
    return File(DROP_IN, (_source() / "systemd" / "lan.conf").read_bytes())


def main_uninstall(args: argparse.Namespace) -> int:
    """Stop, disable, remove."""
    _ready(args)
    present = [file for file in [*files(), lan_drop_in()] if file.found() is not None]
    if any(file.path.name == UNIT for file in present):
        _run(LEAVING, args.dry_run)
    changed = {
        file.path
        for file in present
        if file.found() != file.content and (file.kept or not args.force)
    }
    if any(path.name == UNIT for path in changed):
        # A unit that stays, started again, must find what sends zeros after it.
        changed |= {file.path for file in present if file.path.name == STOP}
    for file in present:
        if file.path in changed:
            print(f"keep    {file.path}  (changed, or needed by what is; --force removes it)")
            continue
        print(f"remove  {file.path}")
        if not args.dry_run:
            file.path.unlink()
            _prune(file.path.parent)
    _run(GONE, args.dry_run)
    return 0


def main_status(args: argparse.Namespace) -> int:
    """Tell; 0 when the service runs."""
    for file in files():
        found = file.found()
        word = (
            "missing" if found is None else "as installed" if found == file.content else "changed"
        )
        print(f"{word:12}  {file.path}")
    try:
        done = subprocess.run(
            ["systemctl", "show", UNIT, "--property=ActiveState,SubState,StatusText,NRestarts"],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        print("systemd does not answer on this machine")
        return 1
    print(done.stdout.strip() or done.stderr.strip())
    return 0 if "ActiveState=active" in done.stdout else 1


def _source() -> Path:
    """The files of `deploy/`: inside the package, or beside it in a clone."""
    import acsard

    package = Path(acsard.__file__).parent
    inside = package / "deploy"
    if inside.is_dir():
        return inside
    clone = package.parent / "deploy"
    if not clone.is_dir():
        raise ExitError(Exit.FAILURE, f"neither {inside} nor {clone} is there; install acsard anew")
    return clone


def _reference(source: Path) -> Path:
    """The reference configuration, which lies beside `deploy/` in a clone."""
    inside = source / "acsard.toml"
    return inside if inside.is_file() else source.parent / "acsard.toml"


def _ready(args: argparse.Namespace) -> None:
    if not args.dry_run and os.geteuid() != 0:
        raise ExitError(Exit.NO_PERMISSION, "run it by sudo, or look at it with --dry-run")


def _run(commands: tuple[tuple[str, ...], ...], dry_run: bool) -> None:
    for command in commands:
        print(f"run     {' '.join(command)}")
        if dry_run:
            continue
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
            failed = done.stderr.strip() if done.returncode else ""
        except (OSError, subprocess.TimeoutExpired) as error:
            failed = str(error)
        if failed and command[1] not in MAY_FAIL:
            raise ExitError(Exit.FAILURE, f"{' '.join(command)}: {failed}")


def _prune(directory: Path) -> None:
    """Remove directories that were made for the file, as far as they are empty."""
    for place in (directory, *directory.parents):
        if place.name not in ("bin", "acsard", "acsard.service.d"):
            return
        try:
            place.rmdir()
        except OSError:
            return  # something else lives there
