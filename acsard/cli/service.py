"""Install acsard as a systemd service: a copy of the program, units, udev rules and a first
configuration. Upgrade it, go back to the version before, remove the service, or show its status.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Iterable
from pathlib import Path

from acsard.cli.common import between
from acsard.host.errors import Exit, MendableError, NotPermittedError
from acsard.machine import service_installation as service
from acsard.machine import upgrade, versions
from acsard.machine.service_installation import Step, missing_prerequisite
from acsard.terminal.output import show, table


def add_options(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(title="actions", required=True)
    for name, main, text in (
        ("install", main_install, "write the service's files, then enable and start the service"),
        ("uninstall", main_uninstall, "stop and disable the service, and remove its files"),
        ("status", main_status, "show which files are installed and whether the service runs"),
        ("upgrade", main_upgrade, "run a new version; go back by itself if it does not work"),
        ("rollback", main_rollback, "run the version again that was in use before"),
    ):
        action = actions.add_parser(name, help=text, description=text.capitalize() + ".")
        if name == "upgrade":
            action.add_argument(
                "new",
                metavar="FILE.deb|DIRECTORY",
                type=Path,
                help="a package of acsard, the environment (venv, uv tool, pipx) with the new "
                "version, or an installed version in /opt/acsard",
            )
        if name in ("upgrade", "rollback"):
            action.add_argument(
                "--wait",
                type=between(0.0, 86400.0, "seconds"),
                metavar="SECONDS",
                default=upgrade.WAIT_S,
                help="wait at most so long until the robot stands (default: %(default)g)",
            )
        if name in ("install", "uninstall"):
            action.add_argument(
                "--dry-run",
                action="store_true",
                help="print every file and command, but change nothing",
            )
        if name == "install":
            action.add_argument(
                "--force",
                action="store_true",
                help="also replace files that differ from those of this version",
            )
        if name == "uninstall":
            action.add_argument(
                "--purge",
                action="store_true",
                help="also remove your configuration, certificates, systemd drop-ins, recordings "
                "and the page's invitations",
            )
        action.set_defaults(main=main)


def main_install(args: argparse.Namespace) -> int:
    _ready(args)
    used = versions.current()
    trouble = missing_prerequisite()
    if used and not versions.is_own(used):
        trouble = (
            f"the service runs version {used}; to change to this one, type `acsard service upgrade "
            f"{sys.prefix}`, which can go back if the new one does not work"
        )
    if trouble:
        print(f"acsard: {trouble}", file=sys.stderr)
        if not (args.dry_run or args.force):
            return Exit.FAILURE
    python = versions.service_python()
    if python != os.path.realpath(sys.executable):
        print(f"the service runs with {python}, because it cannot run {sys.executable}")
    _do([*service.installing(service.files(), force=args.force), *service.linking()], args.dry_run)
    if not args.dry_run:
        print("\nnow set [mcu] and [robot] in /etc/acsard/acsard.toml, then type:")
        print(
            "sudo systemctl restart acsard && sudo acsard doctor --config /etc/acsard/acsard.toml"
        )
    return 0


def main_uninstall(args: argparse.Namespace) -> int:
    _ready(args)
    _do(service.uninstalling(purge=args.purge), args.dry_run)
    return 0


def main_upgrade(args: argparse.Namespace) -> int:
    _require_root()
    _require_service()
    with versions.changing():
        # The watch goes on if the connection of this terminal is lost.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        upgrade.change(upgrade.prepare(args.new.absolute()), _say, args.wait)
    return 0


def main_rollback(args: argparse.Namespace) -> int:
    _require_root()
    _require_service()
    with versions.changing():
        before = versions.previous()
        if before not in versions.installed():
            raise MendableError(
                "there is no version before the one in use; `acsard service upgrade` installs "
                "another one"
            )
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        upgrade.change(before, _say, args.wait)
    return 0


def _say(text: str) -> None:
    try:
        print(text, flush=True)
    except OSError:
        pass  # the terminal is gone, and the change goes on


def _require_service() -> None:
    if not versions.current():
        raise MendableError(
            "the service is not installed; `acsard service install` installs this version"
        )


def main_status(args: argparse.Namespace) -> int:
    """Print the state of files and units; return 0 if the daemon's unit is active, else 1."""
    used = versions.current()
    print(f"version in use: {used or 'none'}")
    if newer := versions.unused():
        print(f"version {newer} is installed, but not in use")
    conditions = [(file.condition(), str(file.path)) for file in service.files()]
    if (versions.HOME / versions.PACKAGE).exists():
        # The package has its units and rules in /usr/lib, and `dpkg --verify acsard` checks them.
        conditions = [row for row in conditions if row[0] != "missing"]
    show(table(conditions))
    states = {unit: service.state(unit) for unit in service.ALL_UNITS}
    print("\n\n".join(f"{unit}:\n{state}" for unit, state in states.items()))
    return 0 if "ActiveState=active" in states[service.UNIT] else 1


def _ready(args: argparse.Namespace) -> None:
    if not args.dry_run and os.geteuid() != 0:
        raise NotPermittedError(
            "run this command with sudo, or add --dry-run to see what the command would do"
        )
    if (versions.HOME / versions.PACKAGE).exists():
        raise MendableError(
            "the Debian package has installed the service: `sudo acsard service upgrade` changes "
            "its version, and `sudo apt remove acsard` removes it"
        )


def _require_root() -> None:
    if os.geteuid() != 0:
        raise NotPermittedError("run this command with sudo")


def _do(steps: Iterable[Step], dry_run: bool) -> None:
    for step in steps:
        print(step)
        if dry_run:
            continue
        try:
            step.do()
        except MendableError:
            raise
        except OSError as error:
            raise MendableError(
                f"this step failed: {step}: {error.strerror}; remove the cause and run the command "
                "again"
            ) from None
