"""Run the daemon at any control rate, to find the highest possible rate. Do not drive with it.

    python -m tests.bench.unlimited --config FILE --port DEVICE --rate HZ

The program reads and checks the configuration file as usual, and then replaces the rate and the
baud rate. The struct checks its values when it is decoded, but not when it is copied, so no check
rejects the new values. Everything else is the unchanged daemon.
"""

from __future__ import annotations

import argparse
import asyncio

from msgspec.structs import replace

from acsard.cli.common import load
from acsard.daemon import daemon
from acsard.host.logs import Log

BAUD_RATE = 4_000_000
"""The highest speed to which a terminal can be set: 33 bytes in 0.08 ms."""


def main() -> None:
    """Run the daemon until it receives SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--config")
    parser.add_argument("--port")
    parser.add_argument("--rate", type=float)
    args = parser.parse_args()
    _, config = load(args.config, {"mcu.port": args.port})
    config = replace(
        config,
        control=replace(config.control, rate=args.rate),
        mcu=replace(config.mcu, baud_rate=BAUD_RATE),
    )
    asyncio.run(daemon.run(config, Log(config.log), lambda device, trouble: None))


if __name__ == "__main__":
    main()
