"""How long after the last line the motors stop: measured by going silent at speed.

One that sends counts tells how far the motors ran; one that reports by its own clock is watched;
any other is asked after silences of different lengths whether it was still turning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec import Struct

from acsard.checkup import counts
from acsard.checkup.bench import PERIOD_S, SLOWEST_S, SPEED, ZERO, Bench
from acsard.checkup.findings import LETTERS, Finding, StoppedError
from acsard.checkup.motion import Reply
from acsard.checkup.turning import mean, run_up
from acsard.config.baud import FIELD
from acsard.mcu.frames import Motors
from acsard.values import NS_PER_S

COARSE_S = 0.05
"""Where two counts take a motor longer, counts tell less than asking does."""

LONGEST_S = 2.5
"""The longest silence; an MCU that drives on for so long has no watchdog."""

FIRST_S = 0.8
"""The first silence: longer than any watchdog that is right, and a motor's run-out."""

FINE_S = 0.03
"""How finely it is found by asking."""

QUICK_S = 0.012
"""Between the two lines that ask: the second reply's speed is of this time."""

TURNING, STOPPED = 0.9, 0.1
"""Shares of the full speed: from here on it has not slowed down; below, it stands."""

UNKNOWN = math.inf


class Silence(Struct, frozen=True):
    """How long the motors ran on after the last line: between these, in s."""

    least: float
    most: float


def measured(bench: Bench, motors: Sequence[int]) -> Silence:
    """How long these motors, which turn as told, run on; they stand again afterwards."""
    if bench.own_clock:
        return _watched(bench, motors)
    if bench.sampled and _fits(bench, motors):
        return _counted(bench, motors)
    return _asked(bench, motors)


def command(motors: Sequence[int]) -> Motors:
    a, b, c, d = (SPEED if motor in motors else 0.0 for motor in range(4))
    return a, b, c, d


def _fast(reply: Reply, motors: Sequence[int]) -> bool:
    """Some motor still turns at more than half its speed."""
    return _share(reply, motors) > 0.5


def at_speed(bench: Bench, motors: Sequence[int]) -> int:
    """Bring the motors to speed; when the last line went."""
    began_ns = bench.wire.now_ns()
    run_up(bench, command(motors))
    shown = mean(_later_half(bench, began_ns))
    if max(abs(shown[motor]) for motor in motors) < SPEED / 2:
        bench.rest()
        names = ", ".join(LETTERS[motor] for motor in motors)
        text = f"motors {names} turned one by one, but not together: does the supply give in?"
        raise StoppedError(Finding("watchdog", "FAIL", "", text, "measure the supply under load"))
    return bench.sent_ns


def _later_half(bench: Bench, began_ns: int) -> list[Reply]:
    """The replies of the second half of the time since then: the ramp is over by then."""
    middle_ns = (began_ns + bench.wire.now_ns()) // 2
    return [reply for reply in bench.replies if reply.at_ns > middle_ns]


class Answer(Struct, frozen=True):
    """What the two lines after a silence of `silent_s` told, in shares of the full speed."""

    silent_s: float
    first: float
    """Of the whole silence where the firmware takes speeds from one line to the next; of the
    moment where it measures by its own clock."""
    second: float
    """Of the moment after; a quick motor has obeyed the first zero by then."""

    @property
    def turned(self) -> bool:
        """The motors had not stopped by themselves."""
        return self.first >= TURNING or self.second >= STOPPED


def _asked(bench: Bench, motors: Sequence[int]) -> Silence:
    """It answers when spoken to: after a silence two quick lines tell what it did meanwhile."""
    stop = _stop(bench, motors)
    least, most = 0.0, UNKNOWN
    for length_s in (FIRST_S + stop.slow_s, max(LONGEST_S, 1.0 + FIRST_S + stop.slow_s)):
        answer = _ask(bench, motors, length_s)
        if not answer.turned:
            most = answer.silent_s
            break
        least = answer.silent_s
    else:
        return Silence(least, UNKNOWN)
    if answer.first >= STOPPED:
        # The mean over the silence: how far it ran, less what it runs out after any stop.
        ran_s = answer.first * answer.silent_s - stop.covered_s
        about_s = QUICK_S + 2 * stop.grain_s
        return Silence(max(0.0, ran_s - about_s), max(0.0, ran_s + about_s))
    for _ in range(8):
        if most - least <= max(FINE_S, 0.1 * most):
            break
        answer = _ask(bench, motors, (least + most) / 2)
        if answer.turned:
            least = max(least, answer.silent_s)
        else:
            most = min(most, answer.silent_s)
    # The reply that tells is of a moment after the silence, as the ordinary stop's is.
    least -= stop.slow_s - QUICK_S + 2 * stop.grain_s
    most -= stop.slow_s - 2 * QUICK_S - 2 * stop.grain_s
    return Silence(max(0.0, least), max(0.0, most))


class Stop(Struct, frozen=True):
    """An ordinary stop: when the motors had nearly stopped, and how long at full speed they would
    have covered what they ran out, s."""

    slow_s: float
    covered_s: float
    grain_s: float
    """How long a motor takes for what its speeds jump by: it cannot be told finer."""


def _stop(bench: Bench, motors: Sequence[int]) -> Stop:
    since_ns = bench.wire.now_ns()
    at_speed(bench, motors)
    grain_s = _grain_s(_later_half(bench, since_ns), motors)
    bench.send(ZERO)
    began_ns, slow_ns = bench.sent_ns, 0
    while not slow_ns and bench.wire.now_ns() - began_ns < SLOWEST_S * NS_PER_S:
        for reply in bench.listen(_quick_s(bench)):
            if not slow_ns and _share(reply, motors) < STOPPED:
                slow_ns = reply.at_ns
        bench.send(ZERO)
    bench.rest()
    slow_s = (slow_ns - began_ns) / NS_PER_S if slow_ns else SLOWEST_S
    return Stop(slow_s, _covered(bench, motors, began_ns), grain_s)


def _grain_s(replies: Sequence[Reply], motors: Sequence[int]) -> float:
    """Whole counts make the speeds of a steady motor jump, by one count in the time of a reply."""
    if len(replies) < 5:
        return 0.0
    between_s = (replies[-1].at_ns - replies[0].at_ns) / NS_PER_S / (len(replies) - 1)
    jumps = []
    for motor in motors:
        speeds = sorted(reply.motors[motor] for reply in replies)
        jumps.append(speeds[-2] - speeds[1])  # one that is damaged is no jump
    return max(jumps) * between_s / SPEED


def _ask(bench: Bench, motors: Sequence[int], length_s: float) -> Answer:
    last_ns = at_speed(bench, motors)
    bench.listen(length_s - (bench.wire.now_ns() - last_ns) / NS_PER_S)
    silent_s = (bench.wire.now_ns() - last_ns) / NS_PER_S
    first, second = tell(bench, motors)
    bench.rest()
    return Answer(silent_s, first, second)


def tell(bench: Bench, motors: Sequence[int]) -> tuple[float, float]:
    """What two quick lines tell of a time without any, in shares of the full speed."""
    before = len(bench.replies)
    bench.send(ZERO)
    bench.listen(_quick_s(bench))
    for _ in range(10):
        bench.send(ZERO)
        bench.listen(bench.period_s)
        if len(bench.replies) >= before + 2:
            break
    shares = [_share(reply, motors) for reply in bench.replies[before : before + 2]]
    first, second = (*shares, 0.0, 0.0)[:2]
    return first, second


def _share(reply: Reply, motors: Sequence[int]) -> float:
    """The fastest of these motors, as a share of the speed they were told."""
    return max(abs(reply.motors[motor]) for motor in motors) / SPEED


def _quick_s(bench: Bench) -> float:
    return max(QUICK_S, bench.period_s if bench.period_s > PERIOD_S else 0.0)


def _watched(bench: Bench, motors: Sequence[int]) -> Silence:
    """It reports by itself: how far its speeds say the motors ran, less their run-out."""
    at_speed(bench, motors)
    bench.send(ZERO)
    began_ns = bench.sent_ns
    bench.rest()
    ran_out_s = _covered(bench, motors, began_ns)
    last_ns = at_speed(bench, motors)
    longest_s = LONGEST_S + bench.slowest_rest_s
    while bench.wire.now_ns() - last_ns < longest_s * NS_PER_S:
        bench.listen(0.02)
        if bench.standing(last_ns):
            break
    still = bool(bench.replies) and _fast(bench.replies[-1], motors)
    ran_s = _covered(bench, motors, last_ns)
    bench.rest()
    if still:
        return Silence(LONGEST_S, UNKNOWN)
    time_s = max(0.0, ran_s - ran_out_s)
    return Silence(max(0.0, time_s - bench.gap_s / 2), time_s + bench.gap_s / 2)


def _covered(bench: Bench, motors: Sequence[int], since_ns: int) -> float:
    """How long at full speed the motors ran since then, as the replies' speeds say, s."""
    ran = [0.0] * 4
    before_ns = since_ns
    for reply in (reply for reply in bench.replies if reply.at_ns > since_ns):
        for motor in motors:
            share = abs(reply.motors[motor]) / SPEED
            ran[motor] += share * (reply.at_ns - before_ns) / NS_PER_S
        before_ns = reply.at_ns
    return max(ran)


# by the encoders' counts


def _fits(bench: Bench, motors: Sequence[int]) -> bool:
    """The longest silence's counts do not wrap, and are fine enough."""
    per_turn = counts.per_turn(bench.replies, motors)
    if per_turn is None or 2 * _count_s(bench, motors) > COARSE_S:
        return False
    return per_turn * 2 * SPEED * LONGEST_S / math.tau < FIELD / 2


def _counted(bench: Bench, motors: Sequence[int]) -> Silence:
    """It sends counts: how far the motors ran in the silence, less their run-out."""
    ran_out_ms = _ran(bench, motors, 0.0)
    for length_s in (FIRST_S, LONGEST_S):
        ran_ms = _ran(bench, motors, length_s)
        still = ran_ms - ran_out_ms > 0.95 * length_s * 1000
        if not still:
            time_s, count_s = (ran_ms - ran_out_ms) / 1000, 2 * _count_s(bench, motors)
            return Silence(max(0.0, time_s - count_s), max(0.0, time_s + count_s))
    return Silence(LONGEST_S, UNKNOWN)


def _count_s(bench: Bench, motors: Sequence[int]) -> float:
    """How long a motor takes for one count: it cannot be told finer."""
    return math.tau / SPEED / (counts.per_turn(bench.replies, motors) or 1.0)


def _ran(bench: Bench, motors: Sequence[int], length_s: float) -> float:
    """How long the motors ran after the last line before a silence, their run-out with it, in ms
    at full speed: the one that ran the longest."""
    began_ns = bench.wire.now_ns()
    last_ns = at_speed(bench, motors)
    bench.listen(max(0.0, 0.03 - (bench.wire.now_ns() - last_ns) / NS_PER_S))
    full = _later_half(bench, began_ns)
    if length_s:
        bench.listen(length_s - (bench.wire.now_ns() - last_ns) / NS_PER_S)
    before, zeros_ns = len(bench.replies), bench.wire.now_ns()
    bench.rest()
    after = bench.replies[before:]
    start_ns, start = (last_ns, full[-1]) if length_s else (zeros_ns, full[-1])
    if not length_s and start.at_ns > last_ns:
        # The first zero's own reading is to hand: all counts from it on are run-out.
        start, start_ns = after[0], 0
    full_ms = max(0.0, (start_ns - start.at_ns) / 1e6)
    return max(_ran_ms(full, [start, *after], motor) for motor in motors) - full_ms


def _ran_ms(at_speed: Sequence[Reply], course: Sequence[Reply], motor: int) -> float:
    made = list(counts.legs(at_speed))
    ms = sum(leg.ms for leg in made)
    turned = sum(leg.counts[motor] for leg in made)
    ran = sum(leg.counts[motor] for leg in counts.legs(course))
    return ran / turned * ms if turned else 0.0
