"""Measure how often messages arrive on a key, and how much the time from one message to the next
varies. Each second until Ctrl-C, the tool prints one line about the last 10 s.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import deque

import msgspec
import numpy as np
import zenoh

from acsard.cli.common import count
from acsard.cli.connection import add_bus, connected, require_followed, silence_explained

SPAN_S = 10.0
"""Largest age of the messages that a line of output describes, s."""

MAX_TIMES = 1_000_000
"""Largest number of arrival times in memory (32 MB).

Python receives fewer messages in `SPAN_S`. So the limit takes effect only while the output is
blocked.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("topic", help="for example odom")
    parser.add_argument("-n", type=count, metavar="N", help="end after N lines")
    parser.add_argument("--json", action="store_true", help="print JSON lines")
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    require_followed(args.topic)
    times: deque[float] = deque(maxlen=MAX_TIMES)
    lines = itertools.count() if args.n is None else range(args.n)
    with connected(args) as robot, silence_explained(robot, args.topic) as on_message:

        def take(_: zenoh.Sample) -> None:
            times.append(time.monotonic())
            on_message()

        subscriber = robot.listen(args.topic, take)
        try:
            for _ in lines:
                time.sleep(1.0)
                now = time.monotonic()
                while times and now - times[0] > SPAN_S:
                    times.popleft()
                figures = rate(list(times))
                text = msgspec.json.encode(figures).decode() if args.json else _line(figures)
                print(text, flush=True)
        except KeyboardInterrupt:
            pass
        subscriber.undeclare()
    return 0


def rate(times: list[float]) -> dict[str, float]:
    """Return the rate of messages, and statistics of the gaps from one message to the next.

    `times` are the arrival times in their order, s. The keys of the result are `count` (number of
    messages), `hz` (rate, Hz), and `gap_min_ms`, `gap_p50_ms`, `gap_p99_ms`, `gap_max_ms` and
    `gap_std_ms` (minimum, percentiles, maximum and standard deviation of the gaps, ms). With fewer
    than two different times, `hz` is 0 and the gaps are left out.
    """
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
