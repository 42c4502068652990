"""The firmware's hardware-independent parts besides the parser, compiled for this machine.

They are the watchdog, the speed measurement, the speed control and the motor bridge.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterable, Iterator

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.each import each
from tests.firmware.board import Library

pytestmark = pytest.mark.slow

TOP = 400
"""PWM_TOP at 16 MHz and 20 kHz."""

TICKS = 2_000_000
"""Ticks of the edge clock per second."""

COUNTS_PER_TURN = 3200

PITCH = math.tau / COUNTS_PER_TURN

REVERSE_TICKS = 2

Edges = Iterable[tuple[int, int]]
"""Time (ticks) and new count of each encoder edge."""


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 400), max_size=40))
def test_the_watchdog_allows_for_300_ms_after_each_feeding_however_the_clock_wraps(
    library: Library, start: int, steps: list[int]
) -> None:
    c, dog = library.c, library.new("watchdog")
    c.watchdog_start(dog)
    now = start
    assert not c.watchdog_allows(dog, now), "boots stopped"
    for step in steps:
        c.watchdog_feed(dog, now)
        for ms in range(0, step, 7):
            assert c.watchdog_allows(dog, (now + ms) % 2**32) == (ms < 300)
        now = (now + step) % 2**32
        assert c.watchdog_allows(dog, now) == (step < 300)
        if step >= 300:
            assert not c.watchdog_allows(dog, (now - step) % 2**32), "tripped, 49 days later"


# speed


def turning(speed: float, seconds: float, counts_per_turn: int = COUNTS_PER_TURN) -> Edges:
    """Return the edges of a wheel with a steady speed in rad/s."""
    rate = abs(speed) / math.tau * counts_per_turn
    way = 1 if speed > 0 else -1
    return [(round(n / rate * TICKS), way * n) for n in range(1, int(rate * seconds))]


def measured(
    library: Library, edges: Edges, windows: Iterable[int], start: int = 0
) -> Iterator[tuple[int, float, int, int]]:
    """Feed these edges to the firmware's speed measurement, once per window.

    Yields the counts turned in the window, the reported speed (rad/s), the length of the window and
    the time (both in ticks).
    """
    wheel = library.new("speed")
    waiting = list(edges)[::-1]
    count = last = edge = now = 0
    library.c.speed_start(wheel, 0, start % 2**32)
    for window in windows:
        now += window
        while waiting and waiting[-1][0] <= now:
            edge, count = waiting.pop()
        value = library.c.speed_update(
            wheel, count % 65536, (start + edge) % 2**32, (start + now) % 2**32
        )
        yield count - last, value, window, now
        last = count


@each("start", [0, 65530, 2**32 - TICKS])
@each("speed", [0.05, 0.3, 1.0, 10.0, 60.0, -0.3, -10.0, -60.0])
@each("every", [0.005, 0.01, 0.02])
def test_a_steady_speed_is_measured_to_a_thousandth(
    library: Library, speed: float, every: float, start: int
) -> None:
    rng = random.Random(1)
    windows = [round(every * (0.75 + rng.random() / 2) * TICKS) for _ in range(round(1 / every))]
    speeds = [value for _, value, *_ in measured(library, turning(speed, 1.5), windows, start)]
    assert speeds[len(speeds) // 2 :] == pytest.approx(
        [speed] * len(speeds[len(speeds) // 2 :]), rel=1e-3, abs=1e-4
    )


def test_the_measured_speed_of_a_wheel_that_stopped_falls_to_zero(library: Library) -> None:
    windows = [TICKS // 100] * 50 + [TICKS // 1000] * 200
    samples = list(measured(library, turning(1.0, 0.5), windows))
    speeds = [value for _, value, *_ in samples[50:]]
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[-1] == 0.0
    assert next(ms for ms, value in enumerate(speeds, 1) if value == 0.0) <= 105


@given(
    st.lists(st.tuples(st.integers(1, 60_000), st.sampled_from((-1, 1, 1))), max_size=200),
    st.lists(st.integers(9_000, 50_000), min_size=1, max_size=200),
    st.integers(0, 2**32 - 1),
)
def test_for_any_edges_the_measured_speed_is_at_most_what_the_window_allows(
    library: Library, steps: list[tuple[int, int]], windows: list[int], start: int
) -> None:
    """Edges come at random times, some reversing, some only microseconds apart.

    The measured speed is at most that of one count more than the window has.
    """
    times = itertools.accumulate(step for step, _ in steps)
    counts = itertools.accumulate(way for _, way in steps)
    before, way = 0.0, 0
    samples = measured(library, zip(times, counts, strict=True), windows, start)
    for turned, value, window, _ in samples:
        step_speed = PITCH / (window / TICKS)
        if not turned:
            assert abs(value) <= abs(before)
            assert value * before >= 0.0
        else:
            assert value * turned >= 0.0
            counted = abs(turned)
            most = counted + 1 if turned * way > 0 else counted - 1
            assert (counted - 1) * step_speed * 0.999 <= abs(value) <= most * step_speed * 1.001
            way = 1 if turned > 0 else -1
        before = value


@pytest.mark.slow
@each("speed", [0.2, 0.3, 0.4, 0.5, 0.6, 0.9, 2.0, -0.2, -0.6])
def test_a_coarse_encoder_measures_the_true_speed_also_at_low_speed(
    coarse_library: Library, speed: float
) -> None:
    """With 96 counts a turn, a wheel at 0.2 rad/s makes one count in 330 ms, or many windows."""
    for every in (0.005, 0.01, 0.02):
        windows = [round(every * TICKS)] * round(20.0 / every)
        samples = list(measured(coarse_library, turning(speed, 20.0, 96), windows))
        settled = [value for _, value, _, now in samples if now > 2.0 * TICKS]
        assert sum(settled) / len(settled) == pytest.approx(speed, rel=0.1)
        assert max(abs(value) for _, value, *_ in samples) < 1.1 * abs(speed), "at the first edge"


def test_the_first_edge_after_a_rest_longer_than_the_clock_gives_no_high_speed(
    library: Library,
) -> None:
    """The 32-bit clock wraps in 36 minutes. An edge before a longer rest must not look recent."""
    rests = [2**32 // 32] * 32
    far = sum(rests)
    edges = [(1000, 1), (far + 15_000, 2), (far + 25_000, 3)]
    speeds = [value for _, value, *_ in measured(library, edges, [10_000, *rests, 10_000, 10_000])]
    assert abs(speeds[-2]) < 1e-5
    assert speeds[-1] == pytest.approx(PITCH / 0.005, rel=0.01)


@given(st.floats(-1e6, 1e6))
def test_speeds_in_hundredths_are_rounded_and_clamped(library: Library, value: float) -> None:
    hundredths = library.c.speed_hundredths(value)
    assert abs(hundredths) <= 9999
    assert abs(hundredths - max(-9999.0, min(9999.0, value * 100))) <= 0.51


# control


def test_the_speed_loop_settles_without_overshoot_and_recovers_from_a_jam(
    library: Library,
) -> None:
    c, pi = library.c, library.new("pi")
    speed, most = 0.0, 0.0
    for tick in range(400):
        duty = c.pi_step(pi, 20.0, speed, False)
        speed = duty * 50.0 + (speed - duty * 50.0) * math.exp(-0.005 / 0.05)
        most = max(most, speed)
        if tick == 199:
            assert speed == pytest.approx(20.0, rel=0.01)
    assert most < 20.0 * 1.03
    for _ in range(1000):  # jammed: it pushes as hard as it can, and no further
        duty = c.pi_step(pi, 20.0, 0.0, False)
    assert duty == 1.0
    freed = [c.pi_step(pi, 20.0, 40.0, False) for _ in range(20)]
    assert freed[-1] < 0.0, "within 100 ms"


@given(st.lists(st.tuples(st.floats(-99, 99), st.floats(-99, 99), st.booleans()), max_size=50))
def test_the_duty_stays_within_its_limits_and_decays_to_zero_at_rest(
    library: Library, steps: list[tuple[float, float, bool]]
) -> None:
    c, pi = library.c, library.new("pi")
    for target, speed, limited in steps:
        assert -1.0 <= c.pi_step(pi, target, speed, limited) <= 1.0
        assert -1.0 <= pi.integral <= 1.0
    duties = [abs(c.pi_step(pi, 0.0, 0.0, False)) for _ in range(100)]
    assert duties == sorted(duties, reverse=True)
    assert duties[-1] == 0.0


# bridge


@example([TOP] * 3 + [0, -TOP])
@example([TOP] * 3 + [None, -TOP, -TOP])
@given(st.lists(st.one_of(st.integers(-TOP, TOP), st.just(0), st.none()), max_size=200))
def test_a_bridge_reverses_only_at_rest_and_its_duty_rises_slowly_and_falls_at_any_rate(
    library: Library, steps: list[int | None]
) -> None:
    """In `steps`, None switches the bridge off between two ticks, as the watchdog does."""
    c, bridge = library.c, library.new("bridge")
    rested, driven = REVERSE_TICKS, 0
    for wanted in steps:
        before = (bridge.duty, bridge.direction)
        if wanted is None:
            c.bridge_off(bridge)
            assert (bridge.duty, bridge.direction) == (0, 0)
            continue
        full = c.bridge_step(bridge, wanted)
        assert full == (bridge.duty * bridge.direction == wanted), (wanted, bridge.duty)
        assert 0 <= bridge.duty <= min(TOP, before[0] + TOP // 10)
        if abs(wanted) <= bridge.duty:
            assert abs(wanted) == bridge.duty
        if bridge.direction != before[1]:
            assert bridge.duty == 0
            assert rested >= REVERSE_TICKS, "without voltage before the inputs change"
        if bridge.duty and driven and bridge.direction != driven:
            assert rested > REVERSE_TICKS, "nor voltage in the tick in which they change"
        rested = 0 if bridge.duty else rested + 1
        driven = bridge.direction if bridge.duty else driven


def test_a_bridge_that_keeps_its_direction_resumes_without_a_rest(library: Library) -> None:
    bridge = library.new("bridge")
    for wanted, duty in ((TOP, 0), (TOP, TOP // 10), (0, 0), (TOP, TOP // 10)):
        library.c.bridge_step(bridge, wanted)
        assert bridge.duty == duty


# supervision


class Wheel:
    """A motor under the firmware's control, one control period at a time, as in main.c."""

    def __init__(
        self,
        library: Library,
        *,
        lag: float = 0.05,
        free_speed: float = 50.0,
        counts: int = COUNTS_PER_TURN,
        encoder: int = 1,
        friction: float = 0.0,
    ) -> None:
        self.c, self.lag, self.free_speed = library.c, lag, free_speed
        self.counts, self.encoder = counts, encoder
        self.force = 0.0
        """Force from outside, as a share of the motor's stall force."""
        self.friction = friction
        """Friction against any motion, as a share of the motor's stall force."""
        self.speed, self.angle, self.duty, self.now = 0.0, 0.0, 0.0, 0
        self.count = self.edge = 0
        self.off_ms = 0
        self.pi, self.bridge = library.new("pi"), library.new("bridge")
        self.speeds, self.supervisor = library.new("speed"), library.new("supervisor")
        self.limited = False

    def run(self, target: float, ms: int) -> bool:
        """Run for `ms`, or until the firmware switches the motor off. Return whether it did so."""
        for _ in range(ms // 5):
            self._turn()
            if self._control(target):
                self.off_ms = self.now // 2000
                return True
        return False

    def _turn(self) -> None:
        for _ in range(25):  # 0.2 ms each
            pull = self.duty + self.force - self.speed / self.free_speed
            grip = self.friction
            if self.speed == 0.0 and abs(pull) <= grip:
                change = 0.0
            else:
                along = self.speed if self.speed else pull
                change = (pull - math.copysign(grip, along)) * self.free_speed / self.lag * 0.0002
            after = self.speed + change
            self.speed = 0.0 if after * self.speed < 0.0 and abs(pull) <= grip else after
            self.now += 400
            self.angle += self.speed * 0.0002 * self.encoder
            count = math.floor(self.angle / math.tau * self.counts)
            if count != self.count:
                self.count, self.edge = count, self.now

    def _control(self, target: float) -> bool:
        c, bridge, count = self.c, self.bridge, self.count % 65536
        speed = c.speed_update(self.speeds, count, self.edge % 2**32, self.now % 2**32)
        if c.supervise_step(self.supervisor, bridge.duty * bridge.direction, speed, count):
            return True
        wanted = int(c.pi_step(self.pi, target, speed, self.limited) * TOP)
        self.limited = not c.bridge_step(bridge, wanted)
        self.duty = bridge.duty * bridge.direction / TOP
        return False


BACKWARDS = -1

DEAD = 0


@each("lag", [0.02, 0.05, 0.2, 0.5])
@each("start", [3.0, -3.0, 0.5, 20.0])
def test_a_wheel_with_its_encoder_backwards_is_switched_off(
    library: Library, lag: float, start: float
) -> None:
    wheel = Wheel(library, lag=lag, encoder=BACKWARDS)
    assert wheel.run(start, 100) or wheel.run(0.0, 2000), "though it shall stand"
    print(f"lag {lag}, {start} rad/s for 100 ms, then zero: off after {wheel.off_ms} ms")
    assert lag > 0.05 or wheel.off_ms <= 500


@pytest.mark.parametrize("target", [3.0, 20.0, -45.0])
def test_a_wheel_that_shows_no_counts_is_switched_off_after_a_second_of_full_voltage(
    library: Library, target: float
) -> None:
    for wheel in (Wheel(library, encoder=DEAD), Wheel(library, friction=2.0)):
        assert wheel.run(target, 5000)
        until_full = 50 + 1000 * (1 - abs(target) / 50) / (abs(target) * 0.4)
        assert wheel.off_ms == pytest.approx(1000 + until_full, rel=0.06)


def test_a_dead_channel_counts_as_a_dead_encoder(library: Library) -> None:
    """With one dead channel the encoder counts one up and one down, for ever.

    The firmware then switches the motor off.
    """
    c, supervisor = library.c, library.new("supervisor")
    steps = [c.supervise_step(supervisor, TOP, 0.0, tick % 2) for tick in range(300)]
    assert steps.index(True) == 199
    for way in (1, -1):
        c.supervise_start(supervisor)
        slow = [way * (tick // 50) % 65536 for tick in range(1000)]
        assert not any(c.supervise_step(supervisor, TOP, 0.0, count) for count in slow)


ACTIONS = st.tuples(
    st.sampled_from([0.0, 0.0, 0.2, -0.2, 1.0, -5.0, 12.0, 30.0, -30.0, 60.0, -99.0]),
    st.integers(20, 700),
    st.one_of(st.just(0.0), st.just(0.0), st.floats(-0.5, 0.5)),
    st.one_of(st.none(), st.none(), st.floats(-20.0, 20.0)),
)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(
    st.floats(0.02, 1.0), st.floats(25.0, 80.0), st.floats(0.0, 0.3), st.booleans(),
    st.lists(ACTIONS, min_size=3, max_size=12),
)  # fmt: skip
def test_a_healthy_wheel_is_never_switched_off(
    library: Library,
    coarse_library: Library,
    lag: float,
    free_speed: float,
    friction: float,
    is_coarse: bool,
    actions: list[tuple[float, int, float, float | None]],
) -> None:
    """Try wheels that are light or heavy and motors that are strong or weak, with much friction.

    A heavy wheel carries the whole robot. A strong or weak motor is faster or slower than
    specified. The test drives and reverses the wheel, and pushes it with half of the motor's stall
    force. It also knocks light wheels.
    """
    built, counts = (coarse_library, 96) if is_coarse else (library, COUNTS_PER_TURN)
    wheel = Wheel(built, lag=lag, free_speed=free_speed, counts=counts, friction=friction)
    for target, ms, force, knocked in actions:
        wheel.force = force
        if knocked is not None and lag <= 0.1:
            wheel.speed = knocked
        assert not wheel.run(target, ms)


def test_a_wheel_that_is_blocked_for_less_than_a_second_is_not_switched_off(
    library: Library,
) -> None:
    wheel = Wheel(library)
    for target in (20.0, -20.0, 45.0, -45.0) * 3:
        wheel.friction = 2.0
        assert not wheel.run(target, 900)
        wheel.friction = 0.0
        assert not wheel.run(target, 300)
