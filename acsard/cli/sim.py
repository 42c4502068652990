"""`acsard sim`: the simulated microcontroller on a pty of its own."""

from __future__ import annotations

import argparse
import sys

from acsard.cli.common import add_config, load
from acsard.sim.fake_mcu import FAULTS


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "sim",
        help="a simulated microcontroller on a pty, for a separate `acsard run --port …`",
        description="Play the microcontroller's side of the serial protocol on a pty, until "
        "Ctrl-C. Prints the device to give to `acsard run --port`.",
    )
    add_config(parser)
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        choices=FAULTS,
        metavar="NAME",
        help=f"misbehave, may be repeated: {', '.join(FAULTS)}",
    )
    parser.add_argument(
        "--link", metavar="PATH", help="also make a symbolic link at PATH to the device"
    )
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Play the MCU until a signal."""
    import asyncio

    _, config = load(args.config)
    return asyncio.run(_play(config, args))


async def _play(config: object, args: argparse.Namespace) -> int:
    import asyncio
    import signal
    from contextlib import ExitStack
    from pathlib import Path

    from acsard.runtime import clock
    from acsard.runtime.sim_pty import SimPty
    from acsard.settings import Config
    from acsard.sim.fake_mcu import FakeMcu

    assert isinstance(config, Config)
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    mcu = FakeMcu(config, clock.now().mono_ns)
    with ExitStack() as stack:
        for fault in args.fault:
            stack.enter_context(getattr(mcu, fault)())
        device = stack.enter_context(SimPty(mcu)).path
        if args.link:
            link = Path(args.link)
            link.unlink(missing_ok=True)
            link.symlink_to(device)
            stack.callback(link.unlink, missing_ok=True)
        print(f"acsard run --port {args.link or device}", flush=True)
        faults = ", ".join(args.fault) or "none"
        print(f"simulated MCU on {device}, faults: {faults}; Ctrl-C ends it", file=sys.stderr)
        await ended.wait()
    print(f"heard {mcu.valid_lines} valid lines", file=sys.stderr)
    return 0
