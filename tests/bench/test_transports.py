"""Print the daemon's cost of feedback, by transport and by number of subscribers and robots.

    pytest -s -m bench tests/bench/test_transports.py

The cost is the processor time of the daemon's process per control cycle, as the kernel counts it.
One daemon uses the transports one after the other. The simulated microcontroller is a separate
process. In the test with many robots each daemon simulates its microcontroller itself.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from statistics import median

import pytest

from acsard.bus.subscription import direct
from acsard.bus.zenoh_sessions import client_session
from acsard.core.config.settings import SIMULATOR, Config
from acsard.core.messages import encodings
from acsard.core.messages.keys_and_roles import full_key
from acsard.core.messages.schema import Message
from acsard.daemon.bus import outlets
from acsard.daemon.bus.bus import ZenohBus
from acsard.host import clock
from tests.bench.rig import Rig, processor_ns
from tests.bench.rigs import config, in_turns, rig, sibling
from tests.unit.core.messages.test_cdr import odometry

FEEDBACK = ("odom", "tf", "wheel_states")
ON_THE_BRIDGE = ("odom", "tf", "joint_states")
"""The ROS names of the same three messages."""


@contextmanager
def listening(settings: Config, keys: Sequence[str], sessions: int = 1) -> Iterator[None]:
    """Run this number of clients that subscribe to all the keys, each with its own connection."""
    with ExitStack() as stack:
        for _ in range(sessions):
            session = client_session(settings.bus.listen[0])
            stack.callback(session.close)
            for key in keys:
                session.declare_subscriber(key, direct(lambda _: None))
            # Messages on one link stay in order. An answer received now follows the subscription.
            alive = session.liveliness().get(full_key(settings.robot.id, "alive"), timeout=3.0)
            assert len(list(alive)) == 1
        yield


def cycle_us(running: Rig, settings: Config, seconds: float) -> float:
    """Return the processor time of the daemon per control period."""
    pid = running.process.pid
    began_ns, used_ns = clock.mono_ns(), processor_ns(pid)
    time.sleep(seconds)
    periods = (clock.mono_ns() - began_ns) / 1e9 * settings.rate_hz
    return (processor_ns(pid) - used_ns) / 1000 / periods


def native(settings: Config) -> tuple[str, ...]:
    return tuple(full_key(settings.robot.id, key) for key in FEEDBACK)


@pytest.mark.bench
@pytest.mark.timeout(300)
def test_the_cost_of_each_transport() -> None:
    settings = config()
    with rig(settings) as running:
        running.unsubscribe()

        def cost(keys: tuple[str, ...]) -> float:
            with listening(settings, keys, 1 if keys else 0):
                return cycle_us(running, settings, 3.0)

        ways: dict[str, Callable[[], float]] = {
            "nobody": partial(cost, ()),
            "native msgpack": partial(cost, native(settings)),
            "bridge CDR": partial(cost, ON_THE_BRIDGE),
            "both": partial(cost, (*native(settings), *ON_THE_BRIDGE)),
        }
        costs = in_turns(ways, 4)
        running.end()
    print("\nodom, tf and wheel states to one client; us of processor time per 10 ms cycle")
    for name, us in costs.items():
        more = f"{us - costs['nobody']:+7.0f}" if name != "nobody" else ""
        print(f"  {name:16}{us:7.0f}{more}   {us / 100:.1f} % of a core")
    # The messages are built once for both forms.
    alone = costs["native msgpack"] + costs["bridge CDR"] - 2 * costs["nobody"]
    assert costs["both"] - costs["nobody"] < alone


@pytest.mark.bench
@pytest.mark.timeout(300)
def test_the_cost_of_more_subscribers() -> None:
    settings = config()
    with rig(settings) as running:
        running.unsubscribe()

        def cost(sessions: int) -> float:
            with listening(settings, native(settings)[:1], sessions):
                return cycle_us(running, settings, 3.0)

        numbers = (0, 1, 4, 16)
        ways: dict[str, Callable[[], float]] = {str(n): partial(cost, n) for n in numbers}
        costs = in_turns(ways, 3)
        running.end()
    print("\nodometry to so many clients; us of processor time per 10 ms cycle")
    for name, us in costs.items():
        print(f"  {name:>3}{us:7.0f}   {us / 100:.1f} % of a core")
    each = (costs["16"] - costs["1"]) / 15
    print(f"  each further client {each:.0f} us")
    # The message is built and encoded once for all of them: a further subscriber only costs the
    # sending.
    assert each < (costs["1"] - costs["0"]) / 2


def missed_and_due(running: Rig) -> tuple[int, float]:
    """Return the number of missed periods and of all periods, from one `state` message.

    Periods are counted from 1970, so only differences are meaningful.
    """
    state = running.state()
    return state.counters.get("missed_periods", 0), state.stamp.to_ns() / 1e9 * config().rate_hz


@pytest.mark.bench
@pytest.mark.timeout(300)
def test_the_cost_of_more_robots() -> None:
    settings, seconds = config(), 8.0
    print("\nrobots on this machine, each with its simulator inside and one subscriber, 100 Hz")
    shares: dict[int, float] = {}
    for number in (1, 4, 16):
        with ExitStack() as stack:
            robots = [
                stack.enter_context(rig(sibling(settings, which), port=SIMULATOR))
                for which in range(number)
            ]
            before = [missed_and_due(robot) for robot in robots]
            used = [processor_ns(robot.process.pid) for robot in robots]
            began_ns = clock.mono_ns()
            time.sleep(seconds)
            took_ns = clock.mono_ns() - began_ns
            costs = [
                (processor_ns(robot.process.pid) - ns) / took_ns
                for robot, ns in zip(robots, used, strict=True)
            ]
            after = [missed_and_due(robot) for robot in robots]
            for robot in robots:
                robot.end_program()
        missed = sum(b[0] - a[0] for a, b in zip(before, after, strict=True))
        periods = sum(b[1] - a[1] for a, b in zip(before, after, strict=True))
        shares[number] = median(costs)
        print(
            f"  {number:3} robots: {100 * median(costs):.1f} % of a core each "
            f"(most {100 * max(costs):.1f} %), {100 * sum(costs):.0f} % of "
            f"{100 * len(os.sched_getaffinity(0))} % together; "
            f"{missed} of {periods:.0f} periods missed ({100 * missed / periods:.2f} %)"
        )
    # The robots share nothing: each costs about as much as a single one.
    assert shares[4] < 3 * shares[1]


# the cost without subscribers


class Nobody:
    """A stand-in for the control loop. The bus notifies it of commands, and it does nothing."""

    def command(self) -> None: ...

    def stop(self) -> None: ...


def encoded(
    monkeypatch: pytest.MonkeyPatch, keys: Sequence[str], settings: Config, count: int
) -> Counter[str]:
    """Publish `count` messages, and return how often the bus encoded them in each format.

    `keys` are the keys of the subscribers.
    """
    made: Counter[str] = Counter()

    def counting(message: Message, form: encodings.Format) -> bytes:
        made[form] += 1
        return encodings.encode(message, form)

    monkeypatch.setattr(outlets, "encode", counting)

    async def publish() -> None:
        async with ZenohBus(settings, Nobody()) as bus:
            with listening(settings, keys, 1 if keys else 0):
                made.clear()  # messages kept for late subscribers
                while len(made) < len(keys):  # Zenoh reports each subscriber in its own time
                    bus.publish("odom", odometry("odom", "base_link"))
                    bus.flush()
                    await asyncio.sleep(0.01)
                await asyncio.sleep(0.2)  # none of these is on its way any more
                made.clear()
                for number in range(1, count + 1):
                    bus.publish("odom", odometry("odom", "base_link"))
                    bus.flush()
                    while keys and max(made.values(), default=0) < number:
                        await asyncio.sleep(0.0005)

    asyncio.run(publish())
    return made


@pytest.mark.slow
def test_a_tree_nobody_listens_to_encodes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, ros = config().robot.id, "odom"
    ours, text = full_key(robot, "odom"), full_key(robot, "json/odom")
    cases: list[tuple[tuple[str, ...], dict[str, int]]] = [
        ((), {}),
        ((ours,), {"msgpack": 50}),
        ((ros,), {"cdr": 50}),
        ((text,), {"json": 50}),
        ((ours, ros), {"msgpack": 50, "cdr": 50}),
        ((ours, text), {"msgpack": 50, "json": 50}),
    ]
    for keys, wanted in cases:
        made = encoded(monkeypatch, keys, config(), 50)
        print(f"{' and '.join(keys) or 'nobody'}: {dict(made)} encodings of 50 messages")
        assert made == wanted
