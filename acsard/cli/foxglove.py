"""Serve the robot's topics, and the service that stops the robot, to Foxglove and Lichtblick (2026
and later) on this machine until Ctrl-C. In Foxglove, open a connection of the type `Foxglove
WebSocket`. The robot's page drives the robot: `acsard web`.
"""

from __future__ import annotations

import argparse
import ipaddress
import signal
import sys

from acsard.cli.robot_options import add_bus, connected
from acsard.core.formatting import lines
from acsard.host.child import end_signals
from acsard.host.errors import Exit, UsageError
from acsard.host.extras import missing

DEFAULT_ADDRESS = "127.0.0.1:8765"  # Foxglove and Lichtblick connect there by default


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--address",
        default=DEFAULT_ADDRESS,
        metavar="HOST:PORT",
        help=f"address to listen at; it must be a loopback address (default: {DEFAULT_ADDRESS})",
    )
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    try:
        from acsard.foxglove.bridge import Bridge
    except ImportError:
        raise missing("foxglove-sdk", "foxglove") from None
    address = loopback(args.address)
    with connected(args) as robot:
        bridge = Bridge(robot, address, _print_message)
        for number in end_signals():
            signal.signal(number, lambda *_: bridge.end())
        try:
            where = f"ws://{address[0]}:{address[1]}: connect Foxglove to this address"
            print(f"{robot.where.robot_id} at {where}", flush=True)
            bridge.run()
        finally:
            bridge.close()
    return Exit.OK


def loopback(text: str) -> tuple[str, int]:
    """Return host and port of HOST:PORT. Raises `UsageError` if it is no loopback address."""
    host, _, digits = text.rpartition(":")
    try:
        address = ipaddress.IPv4Address("127.0.0.1" if host == "localhost" else host)
        port = int(digits)
    except ValueError:
        raise UsageError(f"{text} is not an address: write it like {DEFAULT_ADDRESS}") from None
    if not 0 < port < 65536:
        raise UsageError(f"{text}: a port is a number from 1 to 65535")
    if not address.is_loopback:
        raise UsageError(
            f"other machines could reach {text}, but this protocol has no authentication: every "
            "client that connects could stop the robot. Listen on "
            f"127.0.0.1:{port} and, on the other machine, open a tunnel: "
            f"ssh -N -L {port}:127.0.0.1:{port} USER@ROBOT"
        )
    return str(address), port


def _print_message(text: str) -> None:
    print(f"acsard: {lines(text)}", file=sys.stderr, flush=True)
