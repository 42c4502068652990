"""`acsard mcu check`: prove the microcontroller's side on one's own robot, wheels lifted.

What is looked at, and in which order, is `checkup/procedure.py`'s; who answers is `person.py`'s.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.cli.common import Overrides, add_config, load, writable
from acsard.cli.person import SIMULATOR, answering, ended_by_signals
from acsard.host.colours import coloured
from acsard.host.errors import MendableError
from acsard.host.exits import Exit
from acsard.host.files import change

if TYPE_CHECKING:
    from acsard.checkup.findings import Finding
    from acsard.checkup.outside import Wire
    from acsard.config.settings import Config

DESCRIPTION = """\
Find out on your own robot, wheels lifted, what its microcontroller speaks and whether it keeps
what the robot's safety rests on: baud rate, dialect and trailing comma, reply rate and round trip,
the checked link, each motor and encoder alone, the watchdog, damaged lines. It opens the port
itself: stop the daemon first (exit 75 if it has the port). Motors turn one by one, then
together, after you have typed that the wheels are lifted: told 3 rad/s at the most, but a wheel
whose encoder is dead or reversed can reach full speed. A board that starts anew meanwhile is told,
and what was being looked at is looked at again. The last lines out are zeros, whatever happens,
then silence. Exit 0 when nothing fails, 1 when something does.
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
        "the library tomlkit; without it, it tells what to type)",
    )
    check.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Check and tell."""
    import msgspec

    from acsard.checkup import advice, procedure
    from acsard.checkup.report import failed, report, row, summary

    given: Overrides = {}
    for key, value in (("port", args.port), ("baud_rate", args.baud_rate)):
        if value is not None:
            given.setdefault("mcu", {})[key] = value
    where, config = load(args.config, given)
    _, configured = load(args.config)
    if args.write:
        writable(args.config)
    port = config.mcu.port
    person = answering(args, port)
    findings: list[Finding] = []

    def tell(finding: Finding) -> None:
        findings.append(finding)
        if not args.json:
            person.clear()
            print(row(finding, coloured(sys.stdout)), flush=True)

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
    finally:
        person.clear()
    changes, written = advice.changes(findings, configured, args.port if args.write else ""), ""
    if args.write and changes and not trouble:
        try:
            change(Path(where), changes)
            written = where
        except MendableError as error:  # a minute's findings are told first
            trouble = error
    found = report(port, findings, changes, written, str(trouble or ""))
    print(msgspec.json.encode(found).decode() if args.json else summary(found, where))
    if trouble is not None:
        raise trouble
    return int(Exit.FAILURE if failed(findings) else Exit.OK)


def _wire(config: Config) -> Wire:
    """The port, or the simulator in virtual time: nobody waits for what does not turn."""
    if config.mcu.port == SIMULATOR:
        from acsard.sim.fake_mcu import FakeMcu
        from acsard.sim.virtual_wire import VirtualWire

        return VirtualWire(FakeMcu(config))
    from acsard.serial.blocking import BlockingPort

    return BlockingPort(config.mcu.port)
