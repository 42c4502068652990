"""`acsard sim`: the simulated microcontroller on a pty of its own."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import get_args

from acsard.cli.common import add_config, load
from acsard.config.settings import Baud, Config
from acsard.host.exits import Exit, ExitError
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.faults import ARGUMENTS, FAULTS


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
        type=fault,
        metavar="NAME",
        help=f"misbehave, may be repeated: {', '.join(FAULTS)}; with motors (a to d) or numbers: "
        f"{', '.join(map(_form, ARGUMENTS))}; reset=SECONDS (again and again)",
    )
    parser.add_argument(
        "--link", metavar="PATH", help="also make a symbolic link at PATH to the device"
    )
    parser.set_defaults(main=main)


def _form(name: str) -> str:
    words = {"m": "MOTOR", "n": "NUMBER"}
    return f"{name}={':'.join(words[kind] for kind in ARGUMENTS[name])}"


def fault(text: str) -> tuple[str, tuple[float, ...]]:
    """An argparse type: the name of a fault and its numbers; motors a to d become 0 to 3."""
    name, _, value = text.partition("=")
    given = [v for v in value.split(":") if v]
    wanted = {"reset": "n", **dict.fromkeys(FAULTS, ""), **ARGUMENTS}.get(name)
    if wanted is None or len(given) != len(wanted):
        raise argparse.ArgumentTypeError(f"{text} is not a fault")
    values = []
    for kind, word in zip(wanted, given, strict=True):
        if kind == "m" and word not in ("a", "b", "c", "d"):
            raise argparse.ArgumentTypeError(f"{text}: motors are a, b, c and d")
        try:
            values.append(float("abcd".index(word) if kind == "m" else word))
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text}: {word} is not a number") from None
    if name == "reset" and not values[0] > 0:
        raise argparse.ArgumentTypeError(f"{text}: seconds between resets must be above 0")
    if name == "other_baud" and values[0] not in get_args(Baud):
        raise argparse.ArgumentTypeError(f"{text}: rates are {', '.join(map(str, get_args(Baud)))}")
    return name, tuple(values)


def main(args: argparse.Namespace) -> int:
    """Play the MCU until a signal."""
    import asyncio

    _, config = load(args.config)
    return asyncio.run(_play(config, args))


def _make_link(link: Path, device: str) -> None:
    """A symbolic link to the device; an older link is replaced, nothing else is."""
    try:
        if link.is_symlink():
            link.unlink()
        link.symlink_to(device)
    except OSError as error:
        raise ExitError(
            Exit.USAGE, f"cannot make the link {link}: {error.strerror}; give another --link"
        ) from None


def _reset_again(mcu: FakeMcu, period_s: float) -> None:
    import asyncio

    from acsard.host import clock

    def reset() -> None:
        mcu.reset(clock.now().mono_ns)
        asyncio.get_running_loop().call_later(period_s, reset)

    asyncio.get_running_loop().call_later(period_s, reset)


async def _play(config: Config, args: argparse.Namespace) -> int:
    import asyncio
    import signal
    from contextlib import ExitStack

    from acsard.host import clock
    from acsard.serial.sim_pty import SimPty

    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    mcu = FakeMcu(config, clock.now().mono_ns)
    with ExitStack() as stack:
        for name, values in args.fault:
            if name == "reset":
                _reset_again(mcu, values[0])
            else:
                kinds = ARGUMENTS.get(name, "")
                whole = [
                    int(v) if v.is_integer() or k == "m" else v
                    for k, v in zip(kinds, values, strict=True)
                ]
                stack.enter_context(getattr(mcu, name)(*whole))
        device = stack.enter_context(SimPty(mcu)).path
        if args.link:
            link = Path(args.link)
            _make_link(link, device)
            stack.callback(link.unlink, missing_ok=True)
        print(f"acsard run --port {args.link or device}", flush=True)
        faults = ", ".join(name for name, _ in args.fault) or "none"
        print(f"simulated MCU on {device}, faults: {faults}; Ctrl-C ends it", file=sys.stderr)
        await ended.wait()
    print(f"heard {mcu.valid_lines} valid lines", file=sys.stderr)
    return 0
