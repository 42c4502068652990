"""Print how the daemon's costs grow: with the rate, subscribers, senders, a recording, more robots.

    pytest -s -m bench tests/bench/test_growth.py

Each case runs at the same time as the polled program, which has as many subscribers and senders and
always 100 Hz, so that other programs of the machine slow both equally. Only ratios and counts are
asserted.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from threading import Event, Thread
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from acsard.bus.subscription import direct
from acsard.bus.zenoh_sessions import client_session
from acsard.core.config.settings import Config, RecordConfig
from acsard.core.messages.encodings import encode, encoding_name
from acsard.core.messages.keys_and_roles import full_key
from acsard.core.messages.schema import Twist, Vector3
from acsard.core.messages.signature import Signature
from acsard.host.own_identity import sender_id
from tests.bench.matching import staircase
from tests.bench.rig import ACSARD
from tests.bench.rigs import POLLED, config, delays_us, gap_ns, rig, share, sibling, waits_us
from tests.system.harness import resident_kb

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]

SECONDS, ROUNDS = 4.0, 3

SENDER_PERIOD_S = 0.05


class Case(NamedTuple):
    rate: float = 100.0
    subscribers: int = 1
    senders: int = 1
    record: bool = False
    reply_period: float = 0.0
    """A board that reports by its own clock, s; 0 is a board that answers each line."""


CASES = {
    "50 Hz": Case(rate=50.0),
    "100 Hz": Case(),
    "200 Hz": Case(rate=200.0),
    "300 Hz": Case(rate=300.0),
    "5 subscribers": Case(subscribers=5),
    "20 subscribers": Case(subscribers=20),
    "10 senders": Case(senders=10),
    "16 senders": Case(senders=16),  # the most of a source
    "recording": Case(record=True),
    "free-running board": Case(reply_period=0.01),
}


@contextmanager
def following(settings: Config, subscribers: int) -> Iterator[None]:
    """Run this number of clients that subscribe to the odometry, each with its own connection."""
    with ExitStack() as stack:
        for _ in range(subscribers):
            session = client_session(settings.bus.listen[0])
            stack.callback(session.close)
            session.declare_subscriber(full_key(settings.robot.id, "odom"), direct(lambda _: None))
        yield


@contextmanager
def commanding(settings: Config, senders: int) -> Iterator[None]:
    """Run this number of clients that send zeros at 20 Hz, each with its own connection."""
    over = Event()
    key = full_key(settings.robot.id, f"cmd/{settings.commands.sources[0].name}")
    payload = encode(Twist(Vector3(), Vector3()), "msgpack")
    with ExitStack() as stack:
        publishers = []
        for number in range(senders):
            session = client_session(settings.bus.listen[0])
            stack.callback(session.close)
            publisher = session.declare_publisher(key, encoding=encoding_name("msgpack", "Twist"))
            publishers.append((publisher, Signature(sender_id(f"sender{number}")).pack()))

        def send() -> None:
            while not over.wait(SENDER_PERIOD_S / max(1, senders)):
                publisher, attachment = publishers[0]
                publishers.append(publishers.pop(0))
                publisher.put(payload, attachment=attachment)

        if senders:
            thread = Thread(target=send)
            thread.start()
            stack.callback(thread.join)
            stack.callback(over.set)
        yield


class Costs(NamedTuple):
    ratio: float
    share: float
    resident_kb: int


def costs_of(case: Case, where: Path) -> Costs:
    settings = config(case.rate, case.reply_period)
    if case.record:
        settings = replace(settings, record=RecordConfig(str(where)))
    with ExitStack() as stack:
        ours = stack.enter_context(rig(settings, ACSARD, free_running=case.reply_period))
        polled = sibling(config(), 1)
        theirs = stack.enter_context(rig(polled, POLLED))
        for each in (settings, polled):
            stack.enter_context(following(each, case.subscribers - 1))
            stack.enter_context(commanding(each, case.senders - 1))
        with ThreadPoolExecutor(2) as pool:
            runs = [pool.submit(one.command, SECONDS, staircase) for one in (ours, theirs)]
        own, other = (run.result() for run in runs)
        return Costs(own / other, own, resident_kb(ours.process.pid))


def test_the_cost_of_a_higher_rate_and_of_more_clients(tmp_path: Path) -> None:
    print(f"\n{'':22}{'times polled':>14}{'of a core':>12}{'memory':>12}")
    ratios = {}
    for name, case in CASES.items():
        rounds = [costs_of(case, tmp_path / f"{name} {n}") for n in range(ROUNDS)]
        ratios[name] = median(costs.ratio for costs in rounds)
        core = median(costs.share for costs in rounds)
        memory = max(costs.resident_kb for costs in rounds) / 1024
        print(f"{name:22}{ratios[name]:14.2f}{core:12.1%}{memory:9.1f} MB", flush=True)
    # Twice the rate costs at most twice as much.
    assert ratios["200 Hz"] < 2.2 * ratios["100 Hz"]


def test_the_time_from_the_start_to_the_first_odometry() -> None:
    starts = []
    for _ in range(5):
        with rig(config()) as running:
            starts.append((running.first_odometry_ns - running.started_ns) / 1e9)
    print(f"\nstart to first odometry, s: {', '.join(f'{s:.2f}' for s in sorted(starts))}")
    assert min(starts) < 2.0


ROBOTS = 6


def test_six_robots_on_one_machine() -> None:
    with ExitStack() as stack:
        base = config()
        all_settings = [sibling(base, number) for number in range(ROBOTS)]
        rigs = [stack.enter_context(rig(settings)) for settings in all_settings]
        with ThreadPoolExecutor(ROBOTS) as pool:
            began = time.monotonic()
            runs = [
                pool.submit(running.command, 2 * SECONDS, staircase, number)
                for number, running in enumerate(rigs)
            ]
            shares = [run.result() for run in runs]
            took = time.monotonic() - began
        print(f"\n{ROBOTS} robots on {os.cpu_count()} cores, {took:.0f} s; us")
        print(f"{'':10}{'of a core':>10}{'command':>10}{'p99':>8}{'feedback':>10}{'p99':>8}")
        for number, (settings, running) in enumerate(zip(all_settings, rigs, strict=True)):
            missed = running.state().counters.get("missed_periods", 0)
            record = running.end()
            waits, delays = waits_us(record, gap_ns(settings)), delays_us(settings, record)
            p50, p99 = share(waits, 0.5), share(waits, 0.99)
            f50, f99 = share(delays, 0.5), share(delays, 0.99)
            print(
                f"robot {number:<4}{shares[number]:10.1%}{p50:10.0f}{p99:8.0f}{f50:10.0f}{f99:8.0f}"
                f"   {missed} periods missed"
            )
            assert len(delays) > 0.9 * len(record.feedback_lines)
