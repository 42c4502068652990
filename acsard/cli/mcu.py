"""Work with the microcontroller alone, without the daemon."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import nullcontext
from pathlib import Path

import msgspec

from acsard.checkup import motion, procedure
from acsard.checkup.board import Wire
from acsard.checkup.checkup_report import Changes, changes, report, summary, withheld
from acsard.checkup.findings import Finding
from acsard.cli.borrowed_port import BorrowedPort, Loan
from acsard.cli.common import add_config, add_outcome, add_port, load
from acsard.core.config.motion_rules import top_wheel_speed
from acsard.core.config.parsing import toml_table
from acsard.core.config.settings import SIMULATOR, Config
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.virtual_wire import VirtualWire
from acsard.host import clock
from acsard.host.config_file import change, find, writable
from acsard.host.errors import Exit, MendableError, UsageError
from acsard.host.processes import master_of
from acsard.host.terminal_modes import single_key_mode
from acsard.terminal.prompt import Prompt, TerminalPrompt, ended_by_signals

DESCRIPTION = """\
Test the microcontroller on your own robot with its wheels lifted. The tool finds the protocol of
the board and tests everything that the robot's safety depends on: baud rate, dialect and trailing
comma, reply rate and round trip, the checked link, each motor and encoder alone, the watchdog,
damaged lines, and the emergency stop and the bumpers that the board reports. The tool opens the
port itself. If a daemon on this computer has the port open, and its robot rests, the daemon
switches the robot off and lends the port until the check ends; it must answer at the address in
the configuration, and this user must be an operator or more. Otherwise the exit code is 75. The
tool asks you to type that the wheels are lifted. Then it turns the motors one by one, and then all
together. It commands at most 3 rad/s, and near the end, if the watchdog works and damaged lines are
refused, the highest speed of the limits: the question names it, and with --yes the configuration
file must set it. A wheel whose encoder is dead or reversed can reach full speed. If the board
restarts during a test, the tool reports that and repeats the test. The check ends if the tool
itself could not run for more than 3 s (5 s before the first motor test), for example because the
computer was suspended. The tool always ends by sending zero speeds to the board, and sends nothing
more after them. The exit code is 0 if every test was judged and none failed. It is 1 if a test
failed, if the tool ended early, or if this computer was too slow to judge a test; in that case try
again when the computer is idle.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(title="actions", required=True)
    check = actions.add_parser(
        "check",
        help="test the board's protocol, wheels, watchdog and handling of damaged lines, and print "
        "the settings for acsard.toml",
        description=DESCRIPTION,
    )
    add_config(check)
    add_port(check)
    check.add_argument(
        "--yes",
        action="store_true",
        help="ask no questions. With the simulator, this option is enough; with a robot, "
        "--wheels-are-lifted is needed, too",
    )
    check.add_argument(
        "--wheels-are-lifted",
        action="store_true",
        help="with --yes: confirm that no wheel touches anything and that you watch the robot. The "
        "motors turn at 3 rad/s, and near the end at the highest speed of the limits "
        f"({top_wheel_speed(Config()):.0f} rad/s with the defaults), but only if the configuration "
        "file sets limits.linear_speed and limits.angular_speed, or limits.wheel_speed",
    )
    add_outcome(check, "the settings that the check found, and the device of --port,")


def main(args: argparse.Namespace) -> int:
    where, config = load(args.config, {"mcu.port": args.port})
    _, configured = load(args.config)
    if args.write:
        writable(args.config)
        if why := withheld(config.mcu.simulated, configured):
            raise UsageError(f"--write cannot change {where}: {why}; leave --write out")
    # A person who answers questions confirms the speed. Defaults are nobody's choice.
    fast = not args.yes or _sets_speed(find(args.config)[1])
    with _prompt(args, config, fast) as prompt:
        return _checked(args, config, configured, where, prompt, fast)


def _sets_speed(text: bytes) -> bool:
    limits = toml_table(text).get("limits", {})
    return "wheel_speed" in limits or {"linear_speed", "angular_speed"} <= limits.keys()


def _checked(
    args: argparse.Namespace,
    config: Config,
    configured: Config,
    where: str,
    prompt: Prompt,
    fast: bool,
) -> int:
    # Suggests changes to the file `where`, whose values are `configured`, without options.
    port, simulated = config.mcu.port, config.mcu.simulated
    findings: list[Finding] = []

    def report_finding(finding: Finding) -> None:
        findings.append(finding)
        prompt.show_finding(finding)

    words = " (the built-in SIMULATOR, in simulated time)" if simulated else ""
    prompt.begin(f"port {port}{words}, configuration {where}")
    trouble: MendableError | None = None
    why = withheld(simulated, configured)
    found_changes: Changes = {}
    written = ""
    with (
        ended_by_signals(
            "stopping: acsard sends zero speeds to the board, then closes the port", exits=True
        ),
        single_key_mode() if isinstance(prompt, TerminalPrompt) else nullcontext(),
        Loan(config, prompt.show_text) as loan,
    ):
        try:
            wire = _wire(config, loan)
            procedure.run(wire, prompt, config, report_finding, clock.asleep_ns, fast=fast)
        except MendableError as error:
            if not args.json:
                raise
            # With --json, print the report before the error.
            trouble = error
        if not why:
            # A service has another working directory.
            named = os.path.abspath(args.port) if args.port and "/" in args.port else args.port
            found_changes = changes(findings, configured, named if args.write else "")
        if args.write and found_changes and not trouble:
            loan.outdated = True  # before the change: a signal may end the check after it
            try:
                change(Path(where), found_changes)
                written = where
            except MendableError as error:
                # Print the findings of the long check before the error.
                trouble, loan.outdated = error, False
    result = report(port, findings, found_changes, written, str(trouble or ""), why)
    prompt.result(msgspec.json.encode(result).decode() if args.json else summary(result, where))
    if trouble is not None:
        raise trouble
    return Exit.OK if result.passed else Exit.FAILURE


def _prompt(args: argparse.Namespace, config: Config, fast: bool) -> Prompt:
    # Raises `UsageError` if wheels could turn without a person's consent.
    port = config.mcu.port
    if port == SIMULATOR and args.port != SIMULATOR:
        raise UsageError(
            "no port is configured, so there is no board to check (mcu.port is the simulator, "
            '"sim"). Either find the device with `acsard ports` and run `acsard mcu check --port '
            "DEVICE`, or check the built-in simulator with `--port sim`",
        )
    if not args.yes:
        if not sys.stdin.isatty():
            raise UsageError(
                "mcu check turns the wheels and asks what you see, so run it in a terminal; with "
                "the simulator (--port sim) you can give `--yes` instead",
            )
        return TerminalPrompt(args.json)
    if port == SIMULATOR or args.wheels_are_lifted or not os.path.exists(port):
        return Prompt(args.json)
    master = master_of(port)
    if master is None or master.name != "acsard":
        most = max(motion.SPEED, top_wheel_speed(config) if fast else 0.0)
        what = f"a pty of {master.name}" if master else "not a simulator of acsard"
        raise UsageError(
            f"{port} is {what}: a robot may be connected to it, and --yes would turn its wheels "
            f"at up to {most:.0f} rad/s without a question. Either leave --yes out, or lift the "
            "wheels, stay with the robot and add --wheels-are-lifted",
        )
    return Prompt(args.json)


def _wire(config: Config, loan: Loan) -> Wire:
    if config.mcu.port == SIMULATOR:
        return VirtualWire(FakeMcu(config))
    return BorrowedPort(config.mcu.port, loan)
