"""`acsard mcu check`: prove the microcontroller's side on one's own robot, wheels lifted.

What is looked at, and in which order, is `checkup/procedure.py`'s; here are the port, the person
and what is printed.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from acsard.cli.common import Overrides, add_config, find, load
from acsard.cli.person import Nobody, Person
from acsard.host.errors import MendableError
from acsard.host.exits import Exit, ExitError
from acsard.host.files import change, require_tomlkit

if TYPE_CHECKING:
    from acsard.checkup.findings import Finding
    from acsard.checkup.outside import Wire
    from acsard.config.settings import Config

SIMULATOR = "sim"

COLOURS = {"PASS": 32, "WARN": 33, "FAIL": 31, "SKIPPED": 90}

DESCRIPTION = """\
Find out on your own robot, wheels lifted, what its microcontroller speaks and whether it keeps
what the robot's safety rests on: baud rate, dialect and trailing comma, reply rate and round trip,
the checked link, each motor and encoder alone, the watchdog, damaged lines. It opens the port
itself: stop the daemon first (exit 75 if it has the port). Motors turn one by one, then
together, after you have typed that the wheels are lifted: told 3 rad/s at the most, but a wheel
whose encoder is dead or reversed can reach full speed. The last lines out are zeros, whatever
happens, then silence. Exit 0 when nothing fails, 1 when something does.
"""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "mcu",
        help="prove the microcontroller's side on your own robot, wheels lifted",
        description="What has to do with the microcontroller alone, without the daemon.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    check = actions.add_parser(
        "check",
        help="dialect, wheels, watchdog and damage, and the lines of acsard.toml",
        description=DESCRIPTION,
    )
    add_config(check)
    check.add_argument("--port", metavar="DEVICE", help='serial device of the MCU, or "sim"')
    check.add_argument("--baud-rate", type=int, metavar="N", help="tried first; 9600 to 115200")
    check.add_argument(
        "--yes",
        action="store_true",
        help="ask nothing: on the simulator; on a robot only with --wheels-are-lifted",
    )
    check.add_argument(
        "--wheels-are-lifted",
        action="store_true",
        help="with --yes: you have made sure that no wheel touches anything, and watch the robot",
    )
    check.add_argument("--json", action="store_true", help="print one JSON object")
    check.add_argument(
        "--write",
        action="store_true",
        help="also write the lines into the configuration file, and --port, comments kept (needs "
        "the extra: pip install 'acsard[mcu]')",
    )
    check.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Check and tell."""
    from acsard.checkup import advice, procedure

    given: Overrides = {}
    for key, value in (("port", args.port), ("baud_rate", args.baud_rate)):
        if value is not None:
            given.setdefault("mcu", {})[key] = value
    where, config = load(args.config, given)
    _, configured = load(args.config)
    if args.write:
        _writable(args.config)
    port = config.mcu.port
    _may(args, port)
    person: Person | Nobody = Nobody(args.json) if args.yes else Person()
    findings: list[Finding] = []

    def tell(finding: Finding) -> None:
        findings.append(finding)
        if not args.json:
            print("\n".join(row(finding, sys.stdout.isatty())), flush=True)

    if not args.json:
        simulated = " (the built-in SIMULATOR, in its own time)" if port == SIMULATOR else ""
        print(f"port {port}{simulated}, configuration {where}", flush=True)
    trouble: MendableError | None = None
    try:
        with ended_by_signals():
            procedure.run(_wire(config), person, config, tell)
    except MendableError as error:
        if not args.json:
            raise
        trouble = error  # programs get their object all the same
    changes = advice.changes(findings, configured)
    if args.write and args.port and _answered(findings) and configured.mcu.port != args.port:
        changes = {"mcu.port": args.port, **changes}
    failed = any(finding.verdict == "FAIL" for finding in findings)
    if args.write and changes and not trouble:
        try:
            change(Path(where), changes)
        except ExitError as error:  # a minute's findings are told first
            trouble = error
    written = bool(args.write and changes and not trouble)
    if args.json:
        _print_json(port, findings, changes, where if written else None, trouble)
    else:
        _sum_up(findings, advice.lines(changes), where, written)
    if trouble is not None:
        raise trouble
    return int(Exit.FAILURE if failed else Exit.OK)


def _answered(findings: Sequence[Finding]) -> bool:
    """A board is at the port: its rate was found."""
    return any(finding.name == "baud rate" and finding.keys for finding in findings)


def _wire(config: Config) -> Wire:
    """The port, or the simulator in virtual time: nobody waits for what does not turn."""
    if config.mcu.port == SIMULATOR:
        from acsard.sim.fake_mcu import FakeMcu
        from acsard.sim.virtual_wire import VirtualWire

        return VirtualWire(FakeMcu(config))
    from acsard.serial.blocking import BlockingPort

    return BlockingPort(config.mcu.port)


# who may


def _may(args: argparse.Namespace, port: str) -> None:
    """Raises unless somebody answers for the wheels: a person here, or nothing real can move."""
    if port == SIMULATOR and args.port != SIMULATOR:
        raise ExitError(
            Exit.USAGE,
            "no port is configured, so there is no board to check (mcu.port is the simulator, "
            '"sim"): `acsard ports` lists the serial devices, then `acsard mcu check --port '
            "DEVICE`; `--port sim` checks the built-in simulator",
        )
    if not args.yes:
        if not sys.stdin.isatty():
            raise ExitError(
                Exit.USAGE,
                "mcu check turns the wheels and asks a person who sees them: run it in a "
                "terminal; `--yes` without one is for the simulator (--port sim)",
            )
        return
    if port == SIMULATOR or args.wheels_are_lifted or not os.path.exists(port):
        return
    from acsard.host.processes import master_of

    master = master_of(port)
    if master is None or master.name != "acsard":
        what = f"a pty of {master.name}" if master else "no simulator of acsard's"
        raise ExitError(
            Exit.USAGE,
            f"{port} is {what}: a robot may be behind it, and --yes would turn its wheels without "
            "a question. Leave --yes out; or lift the wheels, stay with the robot, and add "
            "--wheels-are-lifted",
        )


def _writable(path: str | None) -> None:
    require_tomlkit()
    where, text = find(path)
    if not text and not Path(where).is_file():
        raise ExitError(
            Exit.FAILURE,
            "--write has no configuration file to write to: name it by --config, or make an "
            "acsard.toml here (an empty one is valid)",
        )


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Signals end the check by an exception, so that the zeros go out; a second one is too late."""
    # Ctrl-Z too: a check that is suspended would leave a wheel turning.
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
    before = [signal.getsignal(number) for number in numbers]

    def end(number: int, frame: FrameType | None) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        print("\nstopping: zeros go out, then the port is closed", file=sys.stderr)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


# telling


def row(finding: Finding, colours: bool) -> list[str]:
    """A finding for people: verdict, name and figure, then what it means and the mend."""
    mark = f"{finding.verdict:<7}"
    if colours:
        mark = f"\033[{COLOURS[finding.verdict]}m{mark}\033[0m"
    found = [f"{mark} {finding.name:<22} {finding.figure}".rstrip()]
    for lead, text in (("", finding.text), ("-> ", finding.mend)):
        if text:
            indent = " " * 8
            found += textwrap.wrap(
                text, 100, initial_indent=indent + lead, subsequent_indent=indent + " " * len(lead)
            )
    return found


def _sum_up(findings: Sequence[Finding], lines: Sequence[str], where: str, written: bool) -> None:
    counts = {v: sum(1 for f in findings if f.verdict == v) for v in COLOURS}
    print("\n" + ", ".join(f"{n} {v}" for v, n in counts.items() if n))
    if not lines:
        print("acsard.toml: nothing to change")
        return
    print(f"\n{where}: written" if written else "\nfor acsard.toml:")
    print("\n".join(lines))


def _print_json(
    port: str,
    findings: Sequence[Finding],
    changes: dict[str, object],
    written: str | None,
    trouble: MendableError | None,
) -> None:
    import msgspec

    from acsard.checkup import advice

    found = {
        "port": port,
        "passed": _answered(findings) and not any(f.verdict == "FAIL" for f in findings),
        "findings": findings,
        "changes": changes,
        "toml": "\n".join(advice.lines(changes)),
        "written": written,
        "error": str(trouble) if trouble else None,
    }
    print(msgspec.json.encode(found).decode())
