"""Simulate the microcontroller's side of the serial protocol on a pty, until Ctrl-C. The tool
prints the `acsard run` command with the device of the pty.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import sys
from contextlib import ExitStack
from pathlib import Path

from acsard.cli.common import add_config, load
from acsard.core.config.settings import Config
from acsard.core.config.simulated_faults import FAULTS, Parsed, form, parse
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.daemon.serial.simulator_pty import SimPty
from acsard.host import clock
from acsard.host.errors import UsageError

# The words in capitals that the rows of the table do not explain.
LEGEND = """\
faults (MOTOR is the letter of a motor, such as a; START is the time in seconds until the fault
begins, and SECONDS is its duration; 0 SECONDS means that it does not end):"""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    rows = (f"  {form(name)}\n      {fault.text}" for name, fault in FAULTS.items())
    parser.epilog = "\n".join((LEGEND, *rows))
    add_config(parser)
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME",
        help="simulate the fault NAME, such as ftdi or bias=a:0.9, of the list of faults; repeat "
        "the option for several faults",
    )
    parser.add_argument(
        "--link",
        metavar="PATH",
        help="also make a symbolic link at PATH to the simulated serial device",
    )


def main(args: argparse.Namespace) -> int:
    _, config = load(args.config)
    faults = []
    for text in args.fault:
        try:
            faults.append(parse(text, config.mcu.wheels.letters))
        except ValueError as error:
            raise UsageError(f"--fault {text}: {error}") from None
    return asyncio.run(_play(config, args, faults))


def _make_link(link: Path, device: str) -> None:
    try:
        if link.is_symlink():
            if link.exists():
                before = os.readlink(link)
                print(f"{link} now leads to {device}, no longer to {before}", file=sys.stderr)
            link.unlink()
        link.symlink_to(device)
    except OSError as error:
        words = f"cannot make the symbolic link {link}: {error.strerror}; give another --link"
        raise UsageError(words) from None


def _remove_link(link: Path, device: str) -> None:
    # Another program may have replaced the link in the meantime.
    if link.is_symlink() and os.readlink(link) == device:
        link.unlink()


async def _play(config: Config, args: argparse.Namespace, faults: list[Parsed]) -> int:
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    mcu = FakeMcu(config, clock.now().mono_ns)
    with ExitStack() as stack:
        for fault in faults:
            stack.enter_context(mcu.fault(*fault))
        device = stack.enter_context(SimPty(mcu)).path
        if args.link:
            link = Path(args.link)
            _make_link(link, device)
            stack.callback(_remove_link, link, device)
        print(f"acsard run --port {args.link or device}", flush=True)
        listed = ", ".join((*config.sim.faults, *args.fault)) or "none"
        print(f"simulated MCU on {device}, faults: {listed}; Ctrl-C ends it", file=sys.stderr)
        await ended.wait()
    print(f"the simulated MCU received {mcu.valid_lines} valid lines", file=sys.stderr)
    return 0
