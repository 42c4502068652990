"""`acsard hz <topic>`: measure the rate of a key and how even its gaps are."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, count, require_followed, robot_address, warn_of_unknown

if TYPE_CHECKING:
    import zenoh


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "hz",
        help="measure the message rate of a key",
        description="Measure how often messages come on a key and how regular the gaps between "
        "them are. The tool prints one line per second over the last 10 s, until "
        "Ctrl-C.",
    )
    parser.add_argument("topic", help="for example odom")
    parser.add_argument("-n", type=count, metavar="N", help="end after N lines")
    parser.add_argument("--json", action="store_true", help="print JSON lines")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Print a line every second until Ctrl-C or until `-n` lines."""
    from collections import deque

    import msgspec

    from acsard.cli.waiting import explained, lost_by, waits_for
    from acsard.client import connect

    require_followed(args.topic)
    warn_of_unknown(args.topic)
    where = endpoint, robot_id, tls = robot_address(args)
    times: deque[float] = deque(maxlen=10_000)
    left = args.n
    with (
        connect(endpoint, robot_id=robot_id, tls=tls) as robot,
        explained(waits_for(robot, args.topic, where), lost_by(robot, where)) as heard,
    ):

        def take(_: zenoh.Sample) -> None:
            times.append(time.monotonic())
            heard()

        subscriber = robot.listen(args.topic, take)
        try:
            while left is None or left > 0:
                time.sleep(1.0)
                now = time.monotonic()
                while times and now - times[0] > 10.0:
                    times.popleft()
                figures = rate(list(times))
                text = msgspec.json.encode(figures).decode() if args.json else _line(figures)
                print(text, flush=True)
                left = None if left is None else left - 1
        except KeyboardInterrupt:
            pass
        subscriber.undeclare()
    return 0


def rate(times: list[float]) -> dict[str, float]:
    """Return the rate in Hz and the gaps between arrivals in ms, for arrival times in s."""
    import numpy as np

    if len(times) < 2 or times[-1] <= times[0]:
        return {"count": len(times), "hz": 0.0}
    gaps = np.diff(np.asarray(times)) * 1e3
    p50, p99 = np.percentile(gaps, (50, 99))
    return {
        "count": len(times),
        "hz": round(1e3 / float(gaps.mean()), 2),
        "gap_min_ms": round(float(gaps.min()), 2),
        "gap_p50_ms": round(float(p50), 2),
        "gap_p99_ms": round(float(p99), 2),
        "gap_max_ms": round(float(gaps.max()), 2),
        "gap_std_ms": round(float(gaps.std()), 2),
    }


def _line(figures: dict[str, float]) -> str:
    if "gap_min_ms" not in figures:
        return "no messages yet"
    return (
        f"{figures['hz']:8.2f} Hz   gaps ms: min {figures['gap_min_ms']:.2f}  "
        f"p50 {figures['gap_p50_ms']:.2f}  p99 {figures['gap_p99_ms']:.2f}  "
        f"max {figures['gap_max_ms']:.2f}  std {figures['gap_std_ms']:.2f}   "
        f"n {figures['count']:.0f}"
    )
