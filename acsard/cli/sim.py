"""`acsard sim`: the simulated microcontroller on a pty of its own."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from acsard.cli.common import add_config, load
from acsard.runtime.exits import Exit, ExitError
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.faults import FAULTS


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
        help=f"misbehave, may be repeated: {', '.join(FAULTS)}, stuck_encoder=MOTOR, "
        "bias=MOTOR:GAIN (motors a to d), reset=SECONDS (again and again)",
    )
    parser.add_argument(
        "--link", metavar="PATH", help="also make a symbolic link at PATH to the device"
    )
    parser.set_defaults(main=main)


def fault(text: str) -> tuple[str, tuple[float, ...]]:
    """An argparse type: the name of a fault and its numbers; motors a to d become 0 to 3."""
    name, _, value = text.partition("=")
    numbers = [str("abcd".index(v)) if v and v in "abcd" else v for v in value.split(":") if v]
    wanted = {"stuck_encoder": 1, "bias": 2, "reset": 1}
    if len(numbers) != (0 if name in FAULTS else wanted.get(name, -1)):
        raise argparse.ArgumentTypeError(f"{text} is not a fault")
    try:
        values = tuple(float(number) for number in numbers)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: {value} is not a number") from None
    if name in ("stuck_encoder", "bias") and values[0] not in (0, 1, 2, 3):
        raise argparse.ArgumentTypeError(f"{text}: motors are a, b, c and d")
    if name == "reset" and not values[0] > 0:
        raise argparse.ArgumentTypeError(f"{text}: seconds between resets must be above 0")
    return name, values


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

    from acsard.runtime import clock

    def reset() -> None:
        mcu.reset(clock.now().mono_ns)
        asyncio.get_running_loop().call_later(period_s, reset)

    asyncio.get_running_loop().call_later(period_s, reset)


async def _play(config: object, args: argparse.Namespace) -> int:
    import asyncio
    import signal
    from contextlib import ExitStack

    from acsard.runtime import clock
    from acsard.runtime.sim_pty import SimPty
    from acsard.settings import Config

    assert isinstance(config, Config)
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    mcu = FakeMcu(config, clock.now().mono_ns)
    with ExitStack() as stack:
        for name, values in args.fault:
            if name == "reset":
                _reset_again(mcu, values[0])
            elif name == "bias":
                stack.enter_context(mcu.bias(int(values[0]), values[1]))
            elif name == "stuck_encoder":
                stack.enter_context(mcu.stuck_encoder(int(values[0])))
            else:
                stack.enter_context(getattr(mcu, name)())
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
