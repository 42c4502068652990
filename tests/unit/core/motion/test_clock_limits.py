"""Tests of the limits of `Freshness` to the nanosecond.

It accepts a command exactly at a limit and refuses it 1 ns beyond. A sender sends at 20 Hz to a
source with a timeout of 250 ms, unless a test says something else.
"""

from __future__ import annotations

import pickle
from itertools import count

import pytest

from acsard.core.motion.freshness import Freshness, Verdict
from acsard.core.values import NS_PER_S, Command
from tests.each import each
from tests.unit.core.motion.commanders import GO, MS

PERIOD = 50 * MS
TIMEOUT = 250 * MS
PATIENT = 5 * NS_PER_S
"""The timeout of a source with slow senders, ns."""
DRIFT = 10_000
"""The drift that is allowed for in one period, ns."""

Step = tuple[int, int]
"""The time since the command before, and the delay, ns."""


class Sender:
    """A sender and the `Freshness` that checks its commands. Times are in ns."""

    def __init__(self, known: bool = True, steady: bool = False, timeout: int = TIMEOUT) -> None:
        self.freshness, self.steady, self.timeout = Freshness(), steady, timeout
        self.at_ns = NS_PER_S
        if known:
            assert self.steadily(0, 50 if timeout > TIMEOUT else 20)[-1] == "fresh"

    def sends(self, after: int, delay: int, number: int | None = None, clock: str = "a") -> Verdict:
        self.at_ns += after
        stamp_ns = self.at_ns - delay
        command = Command(
            "high", GO, self.at_ns, stamp_ns, clock, sequence=number, steady=self.steady
        )
        return self.freshness.judge(command, self.timeout)

    def each(self, steps: list[Step]) -> list[Verdict]:
        return [self.sends(*step) for step in steps]

    def steadily(self, delay: int, times: int) -> list[Verdict]:
        return [self.sends(PERIOD, delay) for _ in range(times)]


# a known clock


@pytest.mark.parametrize("steady", [True, False])
@pytest.mark.parametrize(("beyond", "verdict"), [(0, "fresh"), (1, "stale")])
def test_a_command_may_be_late_by_the_timeout_and_the_drift(
    steady: bool, beyond: int, verdict: Verdict
) -> None:
    assert Sender(steady=steady).sends(6 * PERIOD, TIMEOUT + 6 * DRIFT + beyond) == verdict


FALL = (PERIOD, DRIFT - 50 * MS)
"""A command that is 50 ms earlier than the minimum."""


@each(
    ("steps", "verdict"),
    [
        ([FALL], "fresh"),
        ([(PERIOD, FALL[1] - 1)], "stale"),
        ([FALL, (0, FALL[1])], "fresh"),
        ([FALL, (0, FALL[1] - 1)], "stale"),
        ([FALL, (0, FALL[1] + 1), (0, FALL[1] - 1)], "stale"),
        ([FALL, (100 * MS, FALL[1] + 2 * DRIFT - 10 * MS)], "fresh"),
        ([FALL, (100 * MS, FALL[1] + 2 * DRIFT - 10 * MS - 1)], "stale"),
        ([FALL, (10 * MS, FALL[1] - 2 * MS)], "stale"),
    ],
)
def test_delays_may_fall_by_50_ms_of_which_a_tenth_of_the_time_is_forgotten(
    steps: list[Step], verdict: Verdict
) -> None:
    assert Sender().each(steps)[-1] == verdict


def test_a_steady_clock_whose_delay_fell_does_not_count_until_it_proves_itself_again() -> None:
    assert Sender(steady=True).each([(PERIOD, -200 * MS), (PERIOD, -40 * MS)]) == [
        "first",
        "unproven",
    ]


@each(
    ("after", "delay", "verdict"),
    [
        (250 * NS_PER_S, 0, "fresh"),
        (250 * NS_PER_S + 1, 0, "first"),
        (250 * NS_PER_S, -1, "stale"),
        (251 * NS_PER_S, NS_PER_S, "stale"),
        (251 * NS_PER_S, NS_PER_S - 1, "first"),
    ],
)
def test_a_clock_is_new_after_250_s_by_both_clocks(
    after: int, delay: int, verdict: Verdict
) -> None:
    assert Sender().sends(after, delay) == verdict


def test_a_repeated_number_with_the_same_stamp_is_stale_even_if_the_number_is_0() -> None:
    sender = Sender()
    assert sender.sends(PERIOD, 0, 0) == "fresh"
    assert sender.sends(10 * MS, 10 * MS, 0) == "stale"


# a proof


@pytest.mark.parametrize(
    ("delay", "verdict"),
    [
        (-50 * MS, "unproven"),
        (-50 * MS - 1, "first"),
        (1000 * MS, "unproven"),
        (1000 * MS + 1, "first"),
    ],
)
def test_a_proof_begins_again_if_the_delay_jumps(delay: int, verdict: Verdict) -> None:
    sender = Sender(known=False)
    assert sender.sends(0, 0) == "first"
    assert sender.sends(PERIOD, delay) == verdict


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "unproven"), (1, "first")])
def test_a_proof_begins_again_after_a_silence_of_over_2_s(beyond: int, verdict: Verdict) -> None:
    sender = Sender(known=False)
    assert sender.sends(0, 0) == "first"
    assert sender.sends(2 * NS_PER_S + beyond, 0) == verdict


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "set"), (1, "stale")])
def test_the_proof_of_a_clock_that_was_set_begins_again_after_a_silence_of_over_2_s(
    beyond: int, verdict: Verdict
) -> None:
    late = 600 * MS
    steps = [(NS_PER_S, late), (2 * NS_PER_S + beyond, late), (750 * MS, late)]
    assert Sender().each(steps) == ["stale", "stale", verdict]


@pytest.mark.parametrize("steady", [True, False])
@pytest.mark.parametrize(("beyond", "verdict"), [(0, "unproven"), (1, "first")])
def test_a_proof_lasts_over_a_silence_of_a_timeout_that_is_longer(
    beyond: int, verdict: Verdict, steady: bool
) -> None:
    sender = Sender(known=False, steady=steady, timeout=PATIENT)
    assert sender.sends(0, 0) == "first"
    assert sender.sends(PATIENT + beyond, 0) == verdict
    assert sender.sends(PATIENT, 0) == ("unproven" if beyond else "fresh")


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "set"), (1, "stale")])
def test_the_proof_of_a_clock_that_was_set_lasts_over_a_silence_of_a_long_timeout(
    beyond: int, verdict: Verdict
) -> None:
    sender, late = Sender(timeout=PATIENT), 10 * NS_PER_S
    steps = [(PERIOD, late), (PERIOD, late), (PATIENT + beyond, late), (NS_PER_S, late)]
    assert sender.each(steps) == ["stale", "stale", "stale", verdict]


def test_a_proof_lasts_over_the_longest_timeout_of_the_sources_of_a_sender() -> None:
    """The sender commands two sources by turns every 3 s.

    The longer timeout of the two decides whether a pause interrupts the proof.
    """
    sender, verdicts = Sender(known=False), list[Verdict]()
    for _ in range(4):
        for sender.timeout in (PATIENT, TIMEOUT):
            verdicts.append(sender.sends(3 * NS_PER_S, 0))
    assert verdicts == ["first", "unproven", *["fresh"] * 6]


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "fresh"), (1, "unproven")])
def test_the_two_halves_of_a_proof_may_differ_by_half_a_percent_of_its_time(
    beyond: int, verdict: Verdict
) -> None:
    half = 125 * MS
    for delay in (half // 100 + beyond, -half // 100 - beyond):
        assert Sender(known=False).each([(0, 0), (half, delay), (half, delay)])[-1] == verdict


@pytest.mark.parametrize(
    "afters",
    [
        (0, 1900 * MS, 50 * MS, 50 * MS, 50 * MS),
        (0, 250 * MS, 50 * MS, 50 * MS, 25 * MS),
    ],
)
def test_a_half_of_a_proof_that_follows_a_silence_lasts_as_long_as_any(
    afters: tuple[int, ...],
) -> None:
    verdicts = Sender(known=False).each([(after, 0) for after in afters])
    assert verdicts == ["first", "unproven", "unproven", "unproven", "fresh"]


EIGHT: dict[str, tuple[list[float], bool]] = {
    "they differ by 50 ms and go up and down": ([0, 60, 50, 70, 0, 60, 50, 70], True),
    "they differ by more than 50 ms": ([30, 0, 60, 50 + 1e-6, 30, 0, 60, 50 + 1e-6], False),
    "they rise by half a percent of the time": ([0, 9, 2, 9, 4, 9, 5, 9], True),
    "they rise by more": ([0, 9, 2, 9, 4, 9, 5 + 1e-6, 9], False),
    "they fall by half a percent of the time": ([5, 9, 4, 9, 2, 9, 0, 9], True),
    "they fall by more": ([5 + 1e-6, 9, 4, 9, 2, 9, 0, 9], False),
}


@each("case", EIGHT)
def test_a_proof_through_jitter_compares_the_minima_of_four_pairs_of_halves(case: str) -> None:
    delays, proved = EIGHT[case]
    half = 125 * MS
    steps = [(half, round(delay * MS)) for delay in [*delays, delays[-1]]]
    verdicts = Sender(known=False).each(steps)
    assert verdicts == ["first", *["unproven"] * 7, "fresh" if proved else "unproven"]


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "fresh"), (1, "unproven")])
def test_a_command_that_ends_a_proof_counts_only_if_it_is_not_late_itself(
    beyond: int, verdict: Verdict
) -> None:
    half = 125 * MS
    steps = [(0, 0), (half, 0), (half, TIMEOUT + beyond)]
    assert Sender(known=False).each(steps)[-1] == verdict


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "set"), (1, "stale")])
def test_a_late_command_at_the_end_of_a_proof_delays_the_proof_by_a_half(
    beyond: int, verdict: Verdict
) -> None:
    """The proof then ends half a proof later. An earlier version took 4.5 s more."""
    sender, late = Sender(), 600 * MS
    assert sender.sends(NS_PER_S, late) == "stale"
    assert set(sender.steadily(late, 29)) == {"stale"}
    assert sender.sends(PERIOD, late + TIMEOUT + beyond) == verdict
    if beyond:
        assert sender.steadily(late, 15) == [*["stale"] * 14, "set"]


def test_a_clock_that_was_prompt_meanwhile_proves_a_new_delay_from_the_start() -> None:
    sender, late = Sender(), 600 * MS
    for _ in range(3):
        assert set(sender.steadily(late, 29)) == {"stale"}
        assert sender.sends(PERIOD, 0) == "fresh"


# a clock that creeps or jumps


@pytest.mark.parametrize(("beyond", "commands"), [(0, 5), (1, 30)])
def test_a_delay_that_changes_by_a_tenth_of_the_time_and_5_ms_creeps_and_proves_itself_sooner(
    beyond: int, commands: int
) -> None:
    sender, crept = Sender(), 255 * MS + beyond
    assert sender.sends(300 * MS, 245 * MS) == "fresh"
    verdicts = sender.steadily(crept, 31)
    assert verdicts.index("set") == commands


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "set"), (1, "stale")])
def test_a_delay_that_creeps_may_go_on_by_a_twentieth_of_the_proof_time(
    beyond: int, verdict: Verdict
) -> None:
    sender, crept, half = Sender(), 255 * MS, 125 * MS
    assert sender.sends(300 * MS, 245 * MS) == "fresh"
    later = crept + 2 * half // 20 + beyond
    assert sender.each([(PERIOD, crept), (half, later), (half, later)])[-1] == verdict


# adjustments that show


def test_the_part_of_a_delay_that_no_adjustment_shows_is_counted() -> None:
    """The sender's clock is set back by 500 ms. Then the network delays commands by 100 ms more.

    The 100 ms count as a delay, and the 500 ms do not.
    """
    sender = Sender()
    begun_ns = sender.at_ns
    sender.each([(PERIOD, 500 * MS), (150 * MS, 600 * MS)])
    while sender.sends(PERIOD, 600 * MS) != "set":
        assert sender.at_ns - begun_ns < 3 * NS_PER_S
    drift = (sender.at_ns - begun_ns) // 5000
    assert sender.freshness.forgiven_ns == 100 * MS - drift


def test_a_delay_from_before_an_adjustment_is_counted() -> None:
    """The network delays commands by 200 ms when the clock is set back by 3 s, and less later."""
    sender = Sender()
    begun_ns = sender.at_ns
    assert sender.sends(300 * MS, 200 * MS) == "fresh"
    sender.sends(PERIOD, 3200 * MS)
    assert sender.steadily(3000 * MS, 31)[-1] == "set"
    drift = (sender.at_ns - begun_ns) // 5000
    assert sender.freshness.forgiven_ns == 200 * MS - drift


def test_a_clock_that_was_set_forward_uses_none_of_the_forgiven_delay() -> None:
    sender = Sender()
    assert sender.steadily(-600 * MS, 31)[-1] == "set"
    assert sender.freshness.forgiven_ns == 0


def test_an_adjustment_that_shows_forgives_no_delay_of_the_network() -> None:
    """The clock is set back by 500 ms, and the network delays all commands by 8 s."""
    sender = Sender()
    sender.sends(PERIOD, 500 * MS)
    sender.sends(PERIOD + 8 * NS_PER_S, 8500 * MS)
    assert set(sender.steadily(8500 * MS, 100)) == {"stale"}


def test_an_adjustment_that_was_believed_forgives_no_later_delay() -> None:
    sender = Sender()
    assert sender.steadily(5000 * MS, 31)[-1] == "set"
    sender.sends(PERIOD + 3 * NS_PER_S, 8000 * MS)
    assert set(sender.steadily(8000 * MS, 100)) == {"stale"}


@pytest.mark.parametrize(("departed", "verdict"), [(10_000, "set"), (10_001, "stale")])
def test_a_clock_that_advances_by_10_us_at_most_counts_as_standing_still(
    departed: int, verdict: Verdict
) -> None:
    sender, late = Sender(), 0
    for _ in range(60):
        late += PERIOD - departed
        sender.sends(PERIOD, late)
    assert verdict in sender.steadily(late, 40)[-10:]


@pytest.mark.parametrize(
    ("departed", "verdict"), [(2_000_000_000, "stale"), (2_000_000_001, "set")]
)
def test_a_sender_that_pauses_for_over_2_s_may_have_set_its_clock(
    departed: int, verdict: Verdict
) -> None:
    sender, late = Sender(), 5 * NS_PER_S
    assert sender.sends(late + departed, late) == "stale"
    assert sender.steadily(late, 30)[-1] == verdict


@pytest.mark.parametrize(("pause", "verdict"), [(PATIENT, "stale"), (PATIENT + 1, "set")])
def test_a_sender_that_lets_its_source_time_out_may_have_set_its_clock(
    pause: int, verdict: Verdict
) -> None:
    sender, late = Sender(timeout=PATIENT), 60 * NS_PER_S
    assert sender.sends(late + pause, late) == "stale"
    assert sender.steadily(late, 40)[-1] == verdict


def test_a_slow_sender_does_not_pause_between_its_commands() -> None:
    """The network delays all commands by 60 s, and the sender sends every 3 s."""
    sender, late = Sender(timeout=PATIENT), 60 * NS_PER_S
    assert sender.sends(3 * NS_PER_S, 0) == "fresh"
    assert sender.sends(3 * NS_PER_S + late, late) == "stale"
    assert {sender.sends(3 * NS_PER_S, late) for _ in range(100)} == {"stale"}


def test_stamps_that_leap_within_a_long_timeout_show_no_pause() -> None:
    sender, late = Sender(timeout=PATIENT), 60 * NS_PER_S
    sender.sends(PERIOD + late + 3 * NS_PER_S, late + 3 * NS_PER_S)
    assert sender.sends(3 * NS_PER_S, late) == "stale"
    assert set(sender.steadily(late, 100)) == {"stale"}


def test_stamps_that_leap_in_commands_that_came_together_show_no_pause() -> None:
    """After a suspend many commands arrive at once, and the daemon drops some of them.

    The stamps of the others therefore leap, although the sender did not pause.
    """
    sender, late = Sender(), 8 * NS_PER_S
    assert sender.sends(5 * NS_PER_S, 4900 * MS) == "stale"
    sender.sends(0, 1900 * MS)
    assert sender.sends(PERIOD + late - 1900 * MS, late) == "stale"
    assert set(sender.steadily(late, 100)) == {"stale"}


@each(
    ("before", "then", "verdict"),
    [
        (7, 8, "set"),
        (7, 51, "stale"),
        (7, 9, "stale"),
        (7, None, "set"),
        (None, 8, "set"),
        (0, 1, "set"),
        (0, 2, "stale"),
        (7, 0, "stale"),
        (7, 7, "stale"),
    ],
)
def test_numbers_distinguish_a_pause_from_a_loss(
    before: int | None, then: int | None, verdict: Verdict
) -> None:
    sender, late = Sender(), 5 * NS_PER_S
    assert sender.sends(PERIOD, 0, before) == "fresh"
    numbers = count(then) if then is not None else None
    verdicts = [
        sender.sends(after, late, next(numbers) if numbers else None)
        for after in (late + 3 * NS_PER_S, *[PERIOD] * 30)
    ]
    assert verdicts == [*["stale"] * 30, verdict]


# adjustments while commands are lost, repeated or swapped

BACK = 30 * NS_PER_S
"""The time by which a clock is set back in these tests, ns."""

Road = list[tuple[int, float, float]]
"""Messages in the order of their arrival: number, true time of sending and of arrival in periods.
The clock is set back by `BACK` before number 101 is sent at period 1."""


class Numbered(Sender):
    """A sender whose commands have sequence numbers.

    Number 100 is the last command before its clock is set back.
    """

    def __init__(self) -> None:
        super().__init__(known=False)
        self.begun_ns = self.at_ns
        verdicts = [self.numbered(100 + n, n, n) for n in range(-40, 1)]
        assert verdicts[-1] == "fresh"

    def numbered(self, number: int, sent: float, arrived: float, back: int = 0) -> Verdict:
        """Send a command whose clock was set back by `back` ns.

        `sent` and `arrived` are true times in periods.
        """
        at_ns = self.begun_ns + round((100 + arrived) * PERIOD)
        stamp_ns = self.begun_ns + round((100 + sent) * PERIOD) - back
        command = Command("high", GO, at_ns, stamp_ns, "a", sequence=number)
        return self.freshness.judge(command, TIMEOUT)

    def after(self, first: int, periods: int = 60, late: float = 0.0) -> list[Verdict]:
        """Send numbers from `first` on with a clock that was set back."""
        numbers = range(first, first + periods)
        return [self.numbered(n, n - 100, n - 100 + late, BACK) for n in numbers]


@pytest.mark.parametrize("lost", [1, 2, 5, 15])
def test_a_clock_is_set_back_while_commands_are_lost(lost: int) -> None:
    sender = Numbered()
    verdicts = sender.after(101 + lost)
    assert verdicts[:33] == [*["stale"] * 30, "set", *["fresh"] * 2]
    assert sender.freshness.forgiven_ns <= (lost + 1) * PERIOD


@pytest.mark.parametrize("every", [2, 3])
def test_a_clock_is_set_back_while_most_commands_are_lost(every: int) -> None:
    sender = Numbered()
    verdicts = [sender.numbered(100 + n, n, n, BACK) for n in range(every - 1, 60 * every, every)]
    assert "set" in verdicts
    assert sender.freshness.forgiven_ns <= every * PERIOD


@pytest.mark.parametrize("later", [0.05, 0.95, 1.5, 20.0])
def test_a_clock_is_set_back_while_every_command_comes_twice(later: float) -> None:
    """The second copy of each command arrives `later` periods after the first copy."""
    sender, verdicts, again = Numbered(), list[Verdict](), set[Verdict]()
    for arrived, n in sorted((n + late, n) for n in range(-20, 41) for late in (0.0, later)):
        if arrived > 0.0:
            verdict = sender.numbered(100 + n, n, arrived, BACK if n > 0 else 0)
            if arrived == n:
                verdicts.append(verdict)
            else:
                again.add(verdict)
    assert verdicts == [*["stale"] * 30, "set", *["fresh"] * 9]
    assert again == {"stale"}
    assert sender.freshness.forgiven_ns <= PERIOD


@each("known", [False, True])
@each(
    ("number", "older", "after", "changes"),
    [
        (9, 0, 1, False),
        (9, 1, 1, False),
        (9, 0, 2 * NS_PER_S, False),
        (0, 1, 1, False),
        (9, 0, 2 * NS_PER_S + 1, True),
        (9, -1, 1, True),
        (10, 1, 1, True),
        (None, 1, 1, True),
    ],
)
def test_a_repeated_command_changes_nothing_until_the_sender_pauses(
    known: bool, number: int | None, older: int, after: int, changes: bool
) -> None:
    """The repeated stamp is `older` ns before the stamp of number 9.

    The repeated command arrives `after` ns after number 9.
    """
    sender = Sender(known=False)
    verdicts = [sender.sends(PERIOD, 0, max(0, n)) for n in range(-20 if known else 6, 10)]
    assert verdicts[-1] == ("fresh" if known else "unproven")
    before = pickle.dumps(sender.freshness)
    assert sender.sends(after, after + older, number) == "stale" or changes
    assert (pickle.dumps(sender.freshness) != before) == changes


@each("older", [0, 1, -1])
def test_a_repeated_command_of_a_clock_that_was_set_back_changes_nothing(older: int) -> None:
    """The repeated command is from before the adjustment.

    Its stamp is later than the newest one.
    """
    sender = Numbered()
    sender.numbered(101, 1, 1, BACK)
    before = pickle.dumps(sender.freshness)
    sender.numbered(100, -older / PERIOD, 1.1)
    assert (pickle.dumps(sender.freshness) != before) == (older < 0)


SWAPS: dict[str, Road] = {
    "the last one before the adjustment comes late": [(102, 2, 2), (101, 0, 2.1), (103, 3, 3)],
    "the first one after it comes late": [(102, 2, 2), (101, 1, 2.1), (103, 3, 3)],
    "the last one before it comes later than its timeout": [
        (102, 2, 2), (103, 3, 3), (101, 0, 6), (103, 3, 6.2), (104, 4, 6.4),
    ],
}  # fmt: skip


@each("swap", SWAPS)
def test_a_clock_is_set_back_while_commands_are_swapped(swap: str) -> None:
    sender = Numbered()
    for number, sent, arrived in SWAPS[swap]:
        sender.numbered(number, sent, arrived, BACK if sent > 0 else 0)
    assert "set" in sender.after(107)
    assert sender.freshness.forgiven_ns <= 3 * PERIOD


def test_lost_commands_excuse_no_delay_beside_an_adjustment() -> None:
    """The clock is set back and commands are lost. All later commands are 5 s late."""
    sender = Numbered()
    assert set(sender.after(110, 100, late=100.0)) == {"stale"}


def test_an_adjustment_counts_once_however_many_commands_are_lost_after_it() -> None:
    """After the adjustment every second command is lost. Then all commands are 5 s late."""
    sender = Numbered()
    for n in range(2, 20, 2):
        assert sender.numbered(100 + n, n, n, BACK) == "stale"
    assert set(sender.after(120, 100, late=100.0)) == {"stale"}


def test_commands_that_are_lost_show_no_adjustment_of_a_clock_that_goes_on() -> None:
    sender = Numbered()
    for n in range(2, 200, 2):
        assert sender.numbered(100 + n, n, n + 100) == "stale"


def test_one_wrong_stamp_after_lost_commands_shows_no_adjustment() -> None:
    sender = Numbered()
    assert sender.numbered(103, 3, 3, 1000 * BACK) == "stale"
    assert {sender.numbered(104 + n, 4 + n, 43 + n) for n in range(100)} == {"stale"}


def test_commands_that_are_replayed_show_no_adjustment_and_never_count() -> None:
    """All later commands are 5 s late, and old commands arrive again between them."""
    sender = Numbered()
    for n in range(1, 100):
        assert sender.numbered(100 + n, n, n + 100) == "stale"
        assert sender.numbered(61 + n % 40, n % 40 - 39, n + 100.3) == "stale"
        assert sender.numbered(62 + n % 40, n % 40 - 38, n + 100.6) == "stale"


def test_commands_from_before_an_adjustment_show_no_second_one_when_they_are_replayed() -> None:
    """The stamps of the replayed commands are later than the stamps after the adjustment."""
    sender = Numbered()
    assert sender.after(101)[-1] == "fresh"
    for number in (98, 99):
        sender.numbered(number, number - 100, 61)
    assert set(sender.after(161, 100, late=100.0)) == {"stale"}


def test_a_late_command_from_before_an_adjustment_hides_no_part_of_it() -> None:
    """The clock is set back by 450 ms.

    Only two later commands have a stamp before the newest one.
    """
    sender, back = Numbered(), 9 * PERIOD
    sender.numbered(102, 2, 2, back)
    assert sender.numbered(101, 0.5, 8) == "stale"
    assert "set" in [sender.numbered(100 + n, n, n, back) for n in range(9, 60)]
    assert sender.freshness.forgiven_ns <= 3 * PERIOD


def test_a_delay_from_before_an_adjustment_is_counted_although_commands_were_lost() -> None:
    """The network delays commands by 500 ms until the clock is set back."""
    sender = Numbered()
    assert sender.numbered(101, 1, 11) == "stale"
    sender.numbered(103, 3, 13, BACK)
    assert "set" in sender.after(114)
    assert 490 * MS <= sender.freshness.forgiven_ns <= 500 * MS


def test_a_stream_that_is_replayed_with_losses_shows_no_adjustment() -> None:
    sender = Numbered()
    for n in range(-41, 0, 2):
        assert sender.numbered(100 + n, n, n + 100) == "stale"
    assert {sender.numbered(101 + n, n, n + 100) for n in range(1, 100, 2)} == {"stale"}


@pytest.mark.parametrize(("accepted", "verdict"), [(0, "set"), (None, "stale")])
def test_lost_commands_show_an_adjustment_only_since_a_command_with_a_number(
    accepted: int | None, verdict: Verdict
) -> None:
    sender = Sender()
    assert sender.sends(PERIOD, 0, accepted) == "fresh"
    if accepted is None:
        sender.sends(PERIOD, 29 * NS_PER_S // 30, 0)
    verdicts = [sender.sends(PERIOD, BACK, number) for number in range(2, 80, 2)]
    assert ("set" in verdicts) == (verdict == "set")


def test_commands_stay_fresh_when_the_numbers_of_their_sender_restart() -> None:
    sender = Numbered()
    assert [sender.numbered(n, n, n) for n in range(1, 40)] == ["fresh"] * 39
    assert "set" in [sender.numbered(n, n, n, BACK) for n in range(40, 80)]


def test_numbers_that_begin_again_with_a_clock_that_was_set_back_count_after_the_proof() -> None:
    """The clock was set back by 0.8 s while the program restarted."""
    sender = Numbered()
    verdicts = [sender.numbered(n, n, n, 800 * MS) for n in range(1, 100)]
    assert verdicts.index("set") <= 40 + 30 + 1


# the budget


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "set"), (1, "stale")])
def test_a_first_jump_by_a_second_and_a_sixtieth_of_the_proof_time_is_forgiven(
    beyond: int, verdict: Verdict
) -> None:
    sender, proof = Sender(), 1500 * MS
    late = NS_PER_S + proof // 60 + (2 * NS_PER_S + proof) // 5000 + beyond
    assert sender.sends(2 * NS_PER_S, late) == "stale"
    assert sender.steadily(late, 30)[-1] == verdict


def test_a_fourth_jump_of_300_ms_is_over_the_second_that_is_forgiven() -> None:
    sender, ends = Sender(), list[Verdict]()
    for jump in range(1, 5):
        assert sender.sends(NS_PER_S, jump * 300 * MS) == "stale"
        ends.append(sender.steadily(jump * 300 * MS, 30)[-1])
    assert ends == ["set", "set", "set", "stale"]


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "set"), (1, "stale")])
def test_a_sixtieth_of_the_time_is_forgiven_after_a_pause_that_used_the_whole_budget(
    beyond: int, verdict: Verdict
) -> None:
    sender, proof, paused = Sender(), 1500 * MS, 5 * NS_PER_S
    sender.sends(paused + 3 * NS_PER_S, paused)
    assert sender.steadily(paused, 30)[-1] == "set"
    assert set(sender.steadily(paused, 17 * 20)) == {"fresh"}
    late = paused + (18 * NS_PER_S + proof) // 60 + (NS_PER_S + proof) // 5000 + beyond
    assert sender.sends(NS_PER_S, late) == "stale"
    assert sender.steadily(late, 30)[-1] == verdict


# many senders


def test_senders_without_a_name_are_distinguished_by_their_source() -> None:
    freshness = Freshness()
    verdicts = [
        freshness.judge(Command(source, GO, n * PERIOD, n * PERIOD - delay), TIMEOUT)
        for n in range(10)
        for source, delay in (("high", 0), ("low", 3600 * NS_PER_S))
    ]
    assert verdicts[-2:] == ["fresh", "fresh"]


def test_the_proof_of_a_sender_among_others_ends_with_a_silence_of_over_2_s_as_well() -> None:
    sender = Sender(known=False)
    assert sender.sends(0, 0) == "first"
    sender.sends(2 * NS_PER_S, 0, clock="b")
    assert sender.sends(0, 0) == "unproven"


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "stale"), (1, "first")])
def test_a_clock_that_is_silent_for_over_an_hour_while_others_send_is_forgotten(
    beyond: int, verdict: Verdict
) -> None:
    sender, hour = Sender(), 3600 * NS_PER_S
    sender.sends(hour + beyond, 0, clock="b")
    assert sender.sends(0, hour) == verdict


def test_the_proof_of_a_slow_sender_among_others_lasts_over_a_silence_of_its_timeout() -> None:
    sender = Sender(known=False, timeout=PATIENT)
    assert sender.sends(0, 0) == "first"
    sender.timeout = TIMEOUT
    sender.sends(PATIENT, 0, clock="b")
    sender.timeout = PATIENT
    assert sender.sends(0, 0) == "unproven"


def test_new_clocks_that_are_silent_for_over_2_s_are_forgotten_before_known_ones() -> None:
    """One known sender is silent for 9 s.

    Meanwhile 200 new senders a second command a slow source.
    """
    sender = Sender()
    sender.timeout = 2 * PATIENT
    for number in range(1800):
        sender.sends(5 * MS, 0, clock=f"stranger {number}")
    sender.timeout = TIMEOUT
    assert sender.sends(PERIOD, 0) == "fresh"


def numbered(
    freshness: Freshness, at_ns: int, number: int, sender: str = "a", timeout: int = TIMEOUT
) -> Verdict:
    command = Command("high", GO, at_ns, sender=sender, sequence=number)
    return freshness.judge(command, timeout)


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "stale"), (1, "fresh")])
def test_numbers_without_stamps_begin_again_after_over_2_s(beyond: int, verdict: Verdict) -> None:
    freshness = Freshness()
    assert numbered(freshness, NS_PER_S, 6) == "fresh"
    assert numbered(freshness, 3 * NS_PER_S + beyond, 5) == verdict


@pytest.mark.parametrize(("beyond", "verdict"), [(0, "stale"), (1, "fresh")])
def test_numbers_without_stamps_begin_again_after_the_timeout_if_it_is_over_2_s(
    beyond: int, verdict: Verdict
) -> None:
    """Before the timeout, the robot may still follow the command with the higher number."""
    freshness = Freshness()
    assert numbered(freshness, NS_PER_S, 6, timeout=PATIENT) == "fresh"
    assert numbered(freshness, NS_PER_S + PATIENT + beyond, 5, timeout=PATIENT) == verdict


@pytest.mark.parametrize(("others", "verdict"), [(1023, "stale"), (1024, "fresh")])
def test_the_numbers_of_1024_senders_without_stamps_are_remembered(
    others: int, verdict: Verdict
) -> None:
    freshness = Freshness()
    assert numbered(freshness, 0, 6) == "fresh"
    for number in range(others):
        numbered(freshness, 1, 1, f"stranger {number}")
    assert numbered(freshness, 2, 5) == verdict


# messages that must not prove a clock


def test_bursts_of_a_backlog_never_count_although_one_burst_ends_a_half_of_a_proof() -> None:
    """The oldest command of each burst has the same delay as the commands of the previous burst."""
    freshness, start = Freshness(), 15 * NS_PER_S
    backlog, number, last, accepted = 5 * NS_PER_S, 0, 0, []
    for burst in range(34):
        at_ns = start + burst * 240 * MS
        while number <= burst * 24 * 1.2 and 10 * NS_PER_S + number * 10 * MS <= at_ns:
            at_ns = last = max(at_ns, last + 400_000)
            sent_ns = 10 * NS_PER_S + number * 10 * MS
            command = Command("high", GO, at_ns, sent_ns, "a", sequence=number, steady=True)
            if freshness.judge(command, TIMEOUT) == "fresh":
                accepted.append(at_ns - sent_ns)
            number += 1
    assert [delay for delay in accepted if delay > backlog // 2] == []


def test_commands_that_come_in_pairs_show_no_clock_that_was_set_back() -> None:
    sender = Sender()
    for pair in range(60 * 50):
        delay = min(3 * NS_PER_S, pair * 10 * MS)
        rise = min(10 * MS, 3 * NS_PER_S - max(0, pair - 1) * 10 * MS) if pair < 301 else 0
        verdicts = sender.each([(18_100_000 + rise, delay), (1_900_000, delay + 1_900_000)])
        assert "set" not in verdicts, f"after {pair / 50} s"


def test_a_new_proof_forgets_how_early_the_commands_before_it_were() -> None:
    sender, period = Sender(known=False, steady=True), 20 * MS
    falls = [100] * 16 + [54] + [44] * 14 + [36] * 14 + [28] * 14 + [20] * 14
    verdicts = sender.each([(period, delay * MS) for delay in falls])
    assert verdicts.count("first") == 2
