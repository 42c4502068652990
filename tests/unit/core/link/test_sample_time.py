"""Tests of a sample's time, from the clock of a free-running board or from an answered line.

The host estimates the board's clock from the times of its reads. It counts each sample slot once,
and soon discards a wrong clock.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from statistics import mode

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.link.sample_time import FreeRunningTimes, PromptedTimes
from tests.each import each

MS = 1_000_000
PERIOD = 0.01


class Bench:
    """Lines with a fixed period, and the number of sample slots that the clock counts for them.

    The host reads each line at once or late.
    """

    def __init__(self, period: float = PERIOD, known: tuple[float, ...] = (PERIOD,)) -> None:
        self.slots = FreeRunningTimes(known)
        self.period_ns = period * 1e9
        self.made = 0
        self.counted = 0.0
        self.waiting = 0
        self.least = 0

    def time_ns(self) -> int:
        return int(5e12 + self.made * self.period_ns)

    def line(self, late_ms: float = 0.0, lost: bool = False, held: bool = False) -> None:
        """Make the MCU's next line.

        The host loses it, or leaves it, or reads it with all waiting lines.
        """
        self.made += 1
        self.waiting += not lost
        if held or not self.waiting:
            return
        had = self.slots.period is not None
        lost_slots = self.slots.process_read(self.time_ns() + int(late_ms * MS), self.waiting, True)
        if had:
            self.counted += self.waiting + lost_slots
            self.least = min(self.least, lost_slots)
        self.waiting = 0

    def until_clock_is_known(self) -> Bench:
        """Send lines until the clock is known."""
        while self.slots.period is None:
            self.line()
            assert self.made < 200
        self.made, self.counted = self._start(), 0.0
        return self

    def _start(self) -> int:
        self.began = self.made
        return self.made

    @property
    def error(self) -> float:
        """Return how many slots too many the clock has counted."""
        return self.counted - (self.made - self.began)


def test_no_period_is_known_before_half_a_second() -> None:
    bench = Bench()
    for _ in range(45):
        bench.line()
        assert bench.slots.period is None
    bench.until_clock_is_known()


@pytest.mark.parametrize(
    ("real", "period"),
    [
        (0.0100001, 0.01),  # the configured period
        (0.01004, 0.01),  # a ceramic resonator matches the configured period as well
        (0.020003, 0.02),  # whole milliseconds
        (0.0333333, 0.0333333),  # the measured period
    ],
)
def test_the_period_is_rounded_to_the_one_that_the_firmware_intends(
    real: float, period: float
) -> None:
    bench = Bench(real)
    for _ in range(400):
        bench.line()
    assert bench.slots.period == pytest.approx(period, rel=1e-6)


def test_punctual_lines_are_not_counted_as_lost() -> None:
    bench = Bench().until_clock_is_known()
    for _ in range(1000):
        bench.line(0.2)
    assert (bench.error, bench.least) == (0, 0)


@pytest.mark.slow
@settings(max_examples=60)
@given(
    stalls=st.lists(st.tuples(st.integers(1, 110), st.floats(0.0, 9.0)), max_size=20),
    seed=st.integers(0, 1000),
    drift=st.floats(-2e-4, 2e-4),
)
def test_a_lossless_link_counts_each_line_once_despite_host_stalls(
    stalls: list[tuple[int, float]], seed: int, drift: float
) -> None:
    chance = random.Random(seed)
    bench = Bench(PERIOD * (1 + drift)).until_clock_is_known()
    for count, late_ms in stalls:
        for _ in range(count):
            bench.line(held=True)
        bench.line(late_ms)
        for _ in range(chance.randint(20, 90)):
            bench.line(chance.uniform(0.0, 1.0) + chance.expovariate(3.0) * 0.3)
    assert bench.error == 0


@given(seed=st.integers(0, 1000), held=st.integers(3, 100))
def test_a_batched_link_without_loss_counts_each_line_once(seed: int, held: int) -> None:
    chance = random.Random(seed)
    slots, waiting, made, counted, stall = FreeRunningTimes((PERIOD,)), 0, 0, 0, 0
    batch_ns = 16 * MS
    for read in range(1, 2000):
        due = read * batch_ns + int(chance.expovariate(1.0) * 0.3 * MS)
        now_made = (read * batch_ns) // (10 * MS)
        waiting += now_made - made
        made = now_made
        stall = held // 2 if read % 300 == 299 else max(0, stall - 1)
        if stall or not waiting:
            continue
        had = slots.period is not None
        lost = slots.process_read(10**12 + due, waiting, True)
        if had:
            counted += lost
        waiting = 0
    assert slots.period == PERIOD
    assert counted == 0


def packets(size: int, lines: int, phase: float) -> list[tuple[int, int]]:
    """Return the time in ns and the line count of each read through an adapter at 115200 baud.

    Lines of `size` bytes come every 10 ms. The adapter passes on 62 bytes as soon as it has them,
    and the rest every 16 ms.
    """
    fed = [(round((k * 10 + phase) * MS + (i + 1) * MS / 11.52), i == size - 1)
           for k in range(1, lines + 1) for i in range(size)]  # fmt: skip
    reads: list[tuple[int, int]] = []
    waiting, whole, due = 0, 0, 0
    for at, ends in fed:
        if waiting and at >= due:
            reads.append((due, whole))
            waiting = whole = 0
        due = due if waiting else -(-at // (16 * MS)) * 16 * MS
        waiting, whole = waiting + 1, whole + ends
        if waiting == 62:
            reads.append((at, whole))
            waiting = whole = 0
    return [(10**12 + at, whole) for at, whole in reads if whole]


@pytest.mark.variations(2)
@pytest.mark.parametrize("size", [30, 33, 34, 36])
@given(phase=st.floats(0.0, 16.0))
def test_lines_that_fill_the_packets_of_an_adapter_keep_their_real_period(
    size: int, phase: float
) -> None:
    slots, counted = FreeRunningTimes((PERIOD,)), 0
    for at, lines in packets(size, 1000, phase):
        had = slots.period is not None
        counted += had * slots.process_read(at, lines, True)
        if not had and slots.period is not None:
            assert slots.period == PERIOD
    assert (slots.period, counted) == (PERIOD, 0)


OUT_OF_TURN = [
    0.0, 0.49, 1.1, 0.68, 1.31, 0.87, 0.53, 1.11, 0.69, 1.29, 0.91, 0.48, 1.09, 0.68, 1.29, 0.97,
    0.51, 1.08, 0.75, 1.32, 1.0, 0.49, 1.09, 0.68, 1.31, 0.91, 1.49, 1.09, 0.68, 1.28, 0.88, 0.52,
]  # fmt: skip
"""Observed lateness of reads during half a second of batches, in slots.

The first line was early, like the first answer after a port opens, because the host's lines follow
each other only after it.
"""


def test_an_early_first_line_does_not_change_the_period_of_a_batched_link() -> None:
    slots, slot, before = FreeRunningTimes((PERIOD,)), 0, 0.0
    for late in [*OUT_OF_TURN, *OUT_OF_TURN[5:]]:
        lines = round(1.6 - late + before)  # the lines of 16 ms
        slot, before = slot + lines, late
        slots.process_read(10**12 + int((slot + late) * 10 * MS), lines, True)
        if slots.period is not None:
            break
    assert slots.period == PERIOD
    assert slots.usual == 10 * MS


@pytest.mark.parametrize("period_ms", [10, 100])
@pytest.mark.parametrize("early", [0.7, 0.84, 0.95])
@pytest.mark.parametrize("turns", [{4}, {11}, {3, 15}, {2, 14}, {5, 9}])
def test_early_replies_to_commands_between_two_periods_do_not_shift_the_slots(
    period_ms: int, early: float, turns: set[int]
) -> None:
    slots, period_ns = FreeRunningTimes((period_ms / 1000,)), period_ms * MS
    for slot in range(120):
        # The command leaves at once instead of with the next period, so its reply is early.
        late = 0.04 * (slot % 4) - (early if slot in turns else 0.0)
        at_ns = 10**12 + int((slot + late) * period_ns)
        slots.process_read(at_ns, 1, True)
        placed = slots.place(0)
        if placed is not None:
            assert at_ns - placed.due_ns < period_ns / 2
    assert slots.period == period_ms / 1000


@pytest.mark.parametrize(
    "odd",
    [
        [0.70, 0.75, 0.80, 1.00, 1.07, 1.10, 1.20, 1.35, 1.40, 1.50, 1.70, 1.80, 1.90],
        [0.60, 0.70, 0.90, 1.00, 1.10, 1.19, 1.30, 1.40, 1.50, 1.54, 1.70, 1.80, 1.84],
    ],
)
def test_replies_to_commands_at_odd_times_do_not_delay_the_slots(
    odd: list[float],
) -> None:
    slots = FreeRunningTimes((0.1,))
    for at in [*odd, *(2.0 + 0.1 * n for n in range(40))]:
        at_ns = 10**12 + int(at * 1e9)
        slots.process_read(at_ns, 1, True)
        placed = slots.place(0)
        assert placed is None or at_ns - placed.due_ns < 50 * MS
    assert slots.period == 0.1


@pytest.mark.parametrize("lost", [1, 2, 7, 50])
def test_missing_lines_are_counted_with_the_next_one(lost: int) -> None:
    bench = Bench().until_clock_is_known()
    for _ in range(100):
        bench.line(0.3)
    for _ in range(lost):
        bench.line(lost=True)
    assert bench.error == -lost
    bench.line(0.3)
    assert bench.error == 0


@given(seed=st.integers(0, 1000))
def test_every_lost_line_is_counted_when_a_fifth_is_lost(seed: int) -> None:
    chance = random.Random(seed)
    bench = Bench().until_clock_is_known()
    for _ in range(2000):
        bench.line(chance.uniform(0.0, 1.0), lost=chance.random() < 0.2)
    bench.line(lost=False)
    bench.line()
    assert bench.error == 0


def test_a_slot_counted_for_a_late_single_line_is_subtracted_at_the_next_line() -> None:
    bench = Bench().until_clock_is_known()
    for _ in range(100):
        bench.line(0.2)
    bench.line(9.0)
    bench.line(0.2)
    bench.line(0.2)
    assert bench.error == 0


def test_lines_missing_in_a_backlog_are_counted_with_the_backlog() -> None:
    bench = Bench().until_clock_is_known()
    for _ in range(100):
        bench.line(0.2)
    for number in range(20):
        bench.line(held=True, lost=number % 5 == 0)
    bench.line(5.0)
    assert bench.error == 0


def forgets(bench: Bench, lines: Iterable[Callable[[], None]]) -> bool:
    """Return whether the host discards the clock during these lines."""
    for line in lines:
        line()
        if bench.slots.period is None:
            return True
    return False


@each("period", [0.005, 0.0093, 0.0108, 0.02, 0.05])
def test_a_changed_period_is_noticed_and_learned(period: float) -> None:
    bench = Bench().until_clock_is_known()
    began = bench.time_ns()
    bench.made, bench.period_ns = 0, period * 1e9
    slots, periods = bench.slots, []
    for number in range(1, 1500):
        slots.process_read(began + int(number * bench.period_ns), 1, True)
        periods.append(slots.period)
    assert None in periods
    assert periods[-1] == pytest.approx(period, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_irregular_lines_have_no_period(seed: int) -> None:
    chance = random.Random(seed)
    slots, at, known = FreeRunningTimes((PERIOD,)), 10**12, 0
    for _ in range(3000):
        at += int(chance.uniform(4.0, 30.0) * MS)
        slots.process_read(at, 1, True)
        known += slots.period is not None
    assert known < 300


def test_the_age_of_a_line_comes_from_its_slot_and_not_from_its_read() -> None:
    bench = Bench().until_clock_is_known()
    chance = random.Random(1)
    errors, raw = [], []
    for number in range(5000):
        late_ms = chance.uniform(0.0, 1.0) + chance.expovariate(1 / 0.3)
        bench.line(late_ms)
        if number > 500:
            placed = bench.slots.place(0)
            assert placed is not None
            errors.append((placed.due_ns - bench.time_ns()) / MS)
            raw.append(late_ms)
    assert deviation(errors) < deviation(raw) / 6


def deviation(values: list[float]) -> float:
    middle = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((value - middle) ** 2 for value in values) / len(values))


def test_a_forgotten_period_is_learned_again() -> None:
    bench = Bench().until_clock_is_known()
    bench.slots.forget()
    assert bench.slots.period is None
    bench.until_clock_is_known()


# boards that answer each line


DELAY_MS = 9.0


class Prompted:
    """A sequence of sent lines and received replies."""

    def __init__(self) -> None:
        self.prompts = PromptedTimes(soonest_ns=6 * MS)

    def leave(self, ms: float) -> None:
        self.prompts.written(int(ms * MS))

    def reply(
        self, ms: float, lines: int = 1, asked_ms: float | None = None, cut: bool = False
    ) -> list[float]:
        """Read this many replies; return the dt and the filled gap of each, in ms.

        `cut` says whether the read also contains the beginning of the next reply.
        """
        self.prompts.process_read(int(ms * MS), lines, cut)
        times = []
        for _ in range(lines):
            asked = None if asked_ms is None else int(asked_ms * MS)
            answered = self.prompts.place(asked)
            assert answered is not None
            times += [round((answered.dt or 0.0) * 1000, 3), round(answered.bridged * 1000, 3)]
        return times

    def talk(self, count: int = 20) -> Prompted:
        """Send `count` lines, one every 10 ms from time 0, and answer each of them."""
        for number in range(count):
            self.leave(number * 10)
            self.reply(number * 10 + DELAY_MS)
        return self


def test_a_reply_without_a_waiting_line_is_not_placed() -> None:
    prompts = PromptedTimes(0)
    prompts.process_read(10 * MS, 1)
    assert prompts.place() is None


def test_the_dt_of_a_reply_is_the_time_between_the_lines() -> None:
    bench = Prompted().talk()
    bench.leave(203.0)
    assert bench.reply(203.0 + DELAY_MS) == [13.0, 0.0]


def test_a_pause_without_sent_lines_fills_no_gap() -> None:
    bench = Prompted().talk()
    bench.leave(440.0)
    assert bench.reply(440.0 + DELAY_MS) == [250.0, 0.0]


def test_a_stalled_read_leaves_each_reply_at_its_line() -> None:
    bench = Prompted().talk()
    bench.leave(200.0)
    bench.leave(410.0)
    assert bench.reply(410.5) == [10.0, 0.0]
    assert bench.reply(410.0 + DELAY_MS) == [210.0, 0.0]


def test_a_lost_reply_is_a_filled_gap() -> None:
    bench = Prompted().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS) == [20.0, 10.0]


def test_a_damaged_reply_is_a_filled_gap() -> None:
    bench = Prompted().talk()
    bench.leave(200.0)
    bench.prompts.process_read(int((200.0 + DELAY_MS) * MS), 1)
    bench.prompts.skip()
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS) == [20.0, 10.0]


def test_a_line_that_was_given_up_too_early_adds_no_time_to_the_replies() -> None:
    bench = Prompted()
    bench.leave(-10.0)
    bench.reply(-10.0 + DELAY_MS - 1.5)  # the earliest time at which an answer may arrive
    bench.talk()
    bench.leave(200.0)
    bench.leave(210.0)
    early, bridged = bench.reply(210.0 + DELAY_MS - 1)  # the answer to the first line, read late
    assert (early, bridged) == pytest.approx((20.0, 10.0), abs=1.0)
    own, nothing = bench.reply(210.0 + DELAY_MS)
    assert (early + own, nothing) == pytest.approx((20.0, 0.0), abs=1.0)
    bench.leave(220.0)
    assert bench.reply(220.0 + DELAY_MS) == pytest.approx([10.0, 0.0], abs=1.0)


def test_a_reply_before_the_minimum_delay_of_a_line_answers_an_earlier_line() -> None:
    bench = Prompted().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS - 1) == [10.0, 0.0]
    assert bench.reply(210.0 + DELAY_MS) == [10.0, 0.0]


def test_two_lines_that_leave_close_together_after_a_stall_make_no_gap() -> None:
    """The answer to the first line comes late and covers the stall. Nothing is left to fill."""
    bench = Prompted().talk()
    bench.leave(400.0)
    bench.leave(403.0)
    assert bench.reply(403.0 + DELAY_MS + 0.2) == [210.0, 0.0]
    assert bench.reply(403.0 + DELAY_MS + 3.0)[1] == 0.0


def test_all_lines_of_a_silence_that_begins_with_two_close_lines_stay_unanswered() -> None:
    """The board answers none of the lines that were sent in the silence.

    The first reply after it must not be taken for a late answer to one of them.
    """
    bench = Prompted().talk()
    for ms in (200.0, 203.9, 220.0, 320.0, 420.0, 520.0, 620.0):
        bench.leave(ms)
    assert bench.reply(620.0 + DELAY_MS) == [430.0, 330.0]
    bench.leave(630.0)
    assert bench.reply(630.0 + DELAY_MS) == [10.0, 0.0]


def test_on_a_lossy_link_the_first_of_two_close_lines_may_be_unanswered() -> None:
    bench = Prompted().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS) == [20.0, 10.0]
    bench.leave(400.0)
    bench.leave(403.0)
    assert bench.reply(403.0 + DELAY_MS + 0.2) == [193.0, 190.0]


def test_a_reply_that_names_its_line_is_matched_without_a_guess() -> None:
    bench = Prompted().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    bench.leave(220.0)
    assert bench.reply(500.0, asked_ms=210.0) == [20.0, 10.0]
    assert bench.reply(500.0, asked_ms=220.0) == [10.0, 0.0]


def test_with_named_lines_the_dt_includes_the_changes_of_the_boards_delay() -> None:
    bench, before = Prompted(), 0.0
    late = (2.1, 1.3, 3.7, 1.0, 4.9, 2.6, 1.8, 3.2)
    for number in range(400):
        thought = late[number % len(late)]
        bench.leave(number * 10)
        dt, _ = bench.reply(number * 10 + 6 + thought, asked_ms=number * 10)
        if number > 100:
            assert dt == pytest.approx(10 + thought - before, abs=0.5)
        before = thought


def test_the_first_reply_is_matched_to_the_newest_possible_line() -> None:
    bench = Prompted()
    for number in range(10):
        bench.leave(number * 10)
    bench.reply(97.0)
    bench.leave(100.0)
    assert bench.reply(107.0) == [10.0, 0.0]


@given(seed=st.integers(0, 10_000))
def test_without_loss_the_dts_add_up_to_the_time_between_the_lines(seed: int) -> None:
    chance = random.Random(seed)
    bench = Prompted().talk()
    at = total = 190.0
    for _ in range(200):
        at += chance.choice([10.0, 10.0, 10.0, 4.0, 90.0])
        bench.leave(at)
        dt, _ = bench.reply(at + DELAY_MS)
        assert dt >= 0.0
        total += dt
    assert total == pytest.approx(at, abs=0.1)


def assigned(prompts: PromptedTimes, replies: dict[int, float], hz: int) -> list[float]:
    """Return by how many ms each reply is matched to a line that is too old.

    Lines are sent for 10 s from 100 ms on. `replies` maps the number of an answered line to the
    delay of its reply, ms.
    """
    lines = [100 + number * 1000 / hz for number in range(10 * hz)]
    events = [(line, 0.0) for line in lines]
    events += [(lines[number] + delay, lines[number]) for number, delay in replies.items()]
    older = []
    for ms, line in sorted(events):
        if not line:
            prompts.written(int(ms * MS))
            continue
        prompts.process_read(int(ms * MS), 1)
        if prompts.place() is not None:
            older.append(line - prompts._line / MS)
    assert len(older) > 0.9 * len(replies)
    return older


def test_a_first_reply_that_is_read_late_hides_no_lost_replies() -> None:
    """The first reply is read 44 ms late. Later only every 16th of 300 lines a second is answered.

    No reply may be matched to a line that is more than one line too old.
    """
    prompts, chance = PromptedTimes(soonest_ns=2 * MS), random.Random(1)
    prompts.written(0)
    prompts.process_read(81 * MS, 1)
    assert prompts.place() is not None
    replies = {n: 37 + 3 * chance.random() for n in range(3000) if n < 15 or n % 16 == 0}
    assert max(assigned(prompts, replies, 300)) < 4.0


@pytest.mark.parametrize(("hz", "each"), [(100, 2), (100, 5), (300, 2), (300, 16)])
@pytest.mark.parametrize("seed", range(5))
def test_a_varying_delay_hides_lost_replies_only_briefly(hz: int, each: int, seed: int) -> None:
    """A board takes 8 to 16 ms for a reply, and after 2 s answers only some of the lines.

    After that no reply may be matched to a line that is more than 20 ms too old.
    """
    prompts, chance = PromptedTimes(soonest_ns=2 * MS), random.Random(seed)
    replies, last = {}, 0.0
    for number in range(10 * hz):
        if number < 2 * hz or number % each == 0:
            at = number * 1000 / hz
            last = max(last, at + 8 + 8 * chance.random())
            replies[number] = last - at
    older = assigned(prompts, replies, hz)
    assert max(older[50:]) <= 21.0


def test_after_forgetting_the_first_reply_has_no_dt() -> None:
    bench = Prompted().talk()
    bench.prompts.forget()
    bench.leave(500.0)
    assert bench.reply(500.0 + DELAY_MS) == [0.0, 0.0]


# an adapter that delivers answers in batches


def batched(
    bench: Prompted,
    seed: int,
    lines: int,
    lost: tuple[int, ...] = (),
    offs: list[int] | None = None,
) -> float:
    """Send a line every 10 ms and read the answers in batches every 16 ms.

    Returns the sum of the times that the answers after the first second cover, ms. `offs` collects
    for each reply the distance, in lines, between its true line and the matched line, plus a
    constant.
    """
    chance, total = random.Random(seed), 0.0
    answers, leaves = [i for i in range(lines) if i not in lost], list(range(lines))
    for batch in range(1, lines * 10 // 16 + 3):
        at = batch * 16.0 + chance.uniform(0.0, 0.5)
        while leaves and leaves[0] * 10 < at:
            bench.leave(leaves.pop(0) * 10)
        ready = [i for i in answers if i * 10 + DELAY_MS <= batch * 16]
        answers = answers[len(ready) :]
        if ready:
            bench.prompts.process_read(int(at * MS), len(ready))
        for number in ready:
            answered = bench.prompts.place()
            if number > 100 and answered is not None:
                total += 1000 * (answered.dt or 0.0)
                if offs is not None:
                    offs.append(round(total / 10) - number)
    return total


@each("seed", range(5))
def test_on_a_batched_link_each_answer_is_matched_to_its_line(seed: int) -> None:
    bench = Prompted()
    assert batched(bench, seed, 300) == pytest.approx(1990.0, abs=0.1)
    assert not bench.prompts.lossy


def test_answers_that_an_adapter_holds_after_a_stall_are_matched_to_their_lines() -> None:
    """The adapter passes on full packets at once, and the rest with its next batch."""
    bench = Prompted()
    batched(bench, 0, 200)
    for n in range(11):
        bench.leave(2020.0 + 10 * n)
    bench.leave(2182.0)
    first = bench.reply(2184.0, lines=9, cut=True)
    bench.leave(2191.0)
    second = bench.reply(2191.5, lines=2, cut=True)
    (last, _) = bench.reply(2194.0)
    assert last == pytest.approx(62.0)
    assert sum(first[::2]) + sum(second[::2]) == pytest.approx(2120.0 - 1990.0)


@each("seed", range(5))
def test_an_answer_lost_on_a_batched_link_is_noticed_soon(seed: int) -> None:
    bench = Prompted()
    assert batched(bench, seed, 300, lost=(150,)) == pytest.approx(1990.0, abs=0.1)


@each("seed", range(5))
def test_a_few_answers_lost_close_together_do_not_make_a_batched_link_lossy(
    seed: int,
) -> None:
    bench = Prompted()
    batched(bench, seed, 170, lost=(150, 153, 156))
    assert not bench.prompts.lossy


@pytest.mark.parametrize("seed", range(5))
def test_on_a_lossy_batched_link_an_answer_is_at_most_one_line_off(seed: int) -> None:
    bench, chance, offs = Prompted(), random.Random(seed), list[int]()
    lost = tuple(number for number in range(1000) if chance.random() < 0.2)
    batched(bench, seed, 1000, lost, offs)
    assert bench.prompts.lossy
    usual = mode(offs)
    assert sum(off == usual for off in offs) > 0.8 * len(offs)
    assert {off - usual for off in offs} <= {-1, 0, 1}


def test_a_stall_of_the_board_does_not_change_the_usual_delay() -> None:
    """After the stall the board answers the waiting lines, and each read has one reply."""
    bench = Prompted().talk(200)
    delay = bench.prompts.latest_ns - 1990 * MS
    for number in range(200, 230):
        bench.leave(number * 10)
    for number in range(200, 230):
        bench.reply(2300 + (number - 199) * 6, asked_ms=number * 10)
    assert bench.prompts.latest_ns - 2290 * MS == pytest.approx(delay, abs=MS)
