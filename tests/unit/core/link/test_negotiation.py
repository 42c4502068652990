"""Tests of the negotiation of the link check: questions, accepted answers, and agreed mode.

They also cover a board that only echoes the lines it receives.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import McuConfig
from acsard.core.link.checked_line import Checked, Reading, has_request
from acsard.core.link.codec import FrameError
from acsard.core.link.negotiation import (
    ANSWER_TIMEOUT_NS,
    MAX_OPEN_LINES,
    MAX_REPLIES_WITHOUT_SAMPLE,
    MAX_UNANSWERED_QUESTIONS,
    SILENT_BOARD_PERIOD_NS,
    TRANSITIONS,
    Negotiation,
    Throttle,
)

MS = 1_000_000
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
GO = b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"
READING = Reading(5, (1, 2, 3, 4))

AUTO = McuConfig(link_check="auto")
SAMPLES = McuConfig(link_check="auto", encoder_counts=3200)
REQUIRE = McuConfig(link_check="require")


class Bench:
    """A negotiation with a simulated time.

    A line counts as sent unless `settle(False)` says otherwise.
    """

    def __init__(self, mcu: McuConfig = AUTO) -> None:
        self.check = Negotiation(mcu, STOP)
        self.now_ns = 1000 * MS

    def questions_within(self, ms: float = 0) -> list[bytes]:
        """Let this time pass in periods of 10 ms without answers, and return the sent questions."""
        asked = []
        for _ in range(int(ms / 10) + 1):
            self.check.settle(True)
            self.check.judge(self.now_ns)
            if self.check.asking:
                line = self.check.question(self.now_ns)
                asked += [] if line is None else [line]
            self.now_ns += 10 * MS
        return asked

    def reply(self, sequence: int, reading: Reading | None = None) -> None:
        self.check.settle(True)
        self.check.answered(Checked(STOP[:-2], sequence, reading), self.now_ns)

    def stale(self, sequence: int) -> bool:
        try:
            self.reply(sequence)
        except FrameError as error:
            return error.reason == "stale_sequence"
        return False

    def drive(self, count: int = 1) -> list[int]:
        """Send this many lines and return their sequence numbers."""
        sequences = []
        for _ in range(count):
            self.check.settle(True)
            sequences.append(sequence_of(self.check.seal(GO, self.now_ns)))
        return sequences

    def checked(self, reading: Reading | None = None) -> Bench:
        """Negotiate until the board has answered."""
        (_, question) = self.questions_within(110)
        self.reply(sequence_of(question), reading)
        assert self.check.checked
        return self


def sequence_of(line: bytes) -> int:
    return int(line.partition(b"#")[2][:2], 16)


def kind(line: bytes) -> str:
    """Return the kind of a line: plain, checked or sampled."""
    suffix = line.partition(b"#")[2]
    return ("sampled" if suffix[2:3] == b"S" else "checked") if suffix else "plain"


# asking


def test_with_the_check_off_lines_leave_unchanged() -> None:
    check = Negotiation(McuConfig(), STOP)
    check.begin(fresh=True)
    assert (check.state, check.in_force) == ("off", "plain")
    assert check.seal(GO, 0) == GO


def test_every_question_to_the_board_is_a_stop() -> None:
    for mcu in (AUTO, SAMPLES, REQUIRE):
        for line in Bench(mcu).questions_within(3000):
            assert line == STOP or line.startswith(STOP[:-2] + b"#")


def test_a_question_that_was_not_sent_is_repeated_immediately() -> None:
    check, ms = Bench().check, 1000
    check.settle(True)
    kinds = []
    for left in (False, False, True, False, True):
        line = check.question(ms * MS)
        assert line is not None
        kinds.append(kind(line))
        check.settle(left)
        if left:
            assert check.question((ms + 1) * MS) is None
            check.settle(True)
            ms += 100
        ms += 1
    assert kinds == ["plain"] * 3 + ["checked"] * 2


def test_a_silent_mcu_gets_plain_and_checked_questions_in_turn_at_10_hz() -> None:
    bench = Bench()
    asked = bench.questions_within(2000)
    assert [kind(line) for line in asked[:4]] == ["plain", "checked", "plain", "checked"]
    assert len(asked) == 21
    assert bench.check.asking


def test_after_a_gap_a_board_that_had_the_check_gets_a_checked_question_first() -> None:
    bench = Bench().checked()
    bench.check.begin()
    assert kind(bench.questions_within()[0]) == "checked"


def test_a_right_reply_to_a_question_confirms_the_check() -> None:
    bench = Bench().checked()
    assert bench.check.in_force == "checked"
    assert kind(bench.check.seal(GO, bench.now_ns)) == "checked"


def test_a_right_reply_to_a_sequence_that_was_not_sent_confirms_nothing() -> None:
    bench = Bench()
    (_, question) = bench.questions_within(110)
    for sequence in set(range(256)) - {sequence_of(question)}:
        assert bench.stale(sequence)
    assert bench.check.asking


def test_a_reply_to_a_question_that_was_not_sent_is_stale() -> None:
    bench = Bench()
    (_, question) = bench.questions_within(100)
    bench.check.settle(False)
    bench.check.settle(True)  # reported once; a later report belongs to another line
    assert bench.stale(sequence_of(question))


def test_unanswered_checked_questions_end_in_the_plain_state() -> None:
    bench = Bench()
    bench.questions_within()
    bench.check.record_plain_reply()
    asked = bench.questions_within(1000)
    assert [kind(line) for line in asked] == ["checked"] * (1 + MAX_UNANSWERED_QUESTIONS)
    assert (bench.check.state, bench.check.in_force) == ("plain", "plain")
    assert bench.check.seal(GO, bench.now_ns) == GO


def test_the_board_is_asked_three_times_with_samples_and_then_three_times_without() -> None:
    bench = Bench(SAMPLES)
    bench.questions_within()
    bench.check.record_plain_reply()
    asked = bench.questions_within(2000)
    assert [kind(line) for line in asked] == ["sampled"] * MAX_UNANSWERED_QUESTIONS + [
        "checked"
    ] * MAX_UNANSWERED_QUESTIONS
    assert bench.check.state == "plain"


def test_questions_that_were_not_sent_are_not_counted() -> None:
    bench = Bench()
    bench.check.record_plain_reply()
    for _ in range(300):
        if bench.questions_within():
            bench.check.settle(False)
    assert bench.check.asking


def test_a_question_is_counted_once_however_often_the_negotiation_is_judged() -> None:
    bench = Bench()
    bench.check.record_plain_reply()
    bench.questions_within()
    for _ in range(100):
        bench.now_ns += 10 * MS
        bench.check.judge(bench.now_ns)
    assert bench.check.asking


def test_a_silent_board_is_asked_for_ever() -> None:
    bench = Bench(SAMPLES)
    bench.questions_within(60_000)
    assert bench.check.asking
    assert not bench.check.trouble


def test_a_board_on_a_slow_wire_has_more_time_to_answer() -> None:
    bench = Bench(McuConfig(link_check="auto", baud_rate=9600))
    bench.check.record_plain_reply()
    bench.questions_within(4 * 190)
    assert bench.check.in_force == "not checked yet"
    bench.questions_within(100)
    assert bench.check.in_force == "plain"


def test_a_required_check_that_is_refused_is_asked_for_ever_with_its_reason() -> None:
    bench = Bench(REQUIRE)
    bench.check.record_plain_reply()
    assert len(bench.questions_within(5000)) > 50
    assert (bench.check.asking, bool(bench.check.trouble)) == (True, True)
    assert bench.check.trouble == "unknown"
    (question,) = bench.questions_within(40)
    bench.reply(sequence_of(question))
    assert (bench.check.state, bench.check.trouble) == ("checked", "")


def test_a_board_that_answered_with_a_check_is_not_accepted_without_it() -> None:
    bench = Bench().checked()
    bench.check.begin()
    bench.check.record_plain_reply()
    bench.questions_within(5000)
    assert bench.check.asking
    assert bench.check.trouble == "forgotten"


def test_a_new_opening_forgets_that_a_board_had_the_check() -> None:
    bench = Bench().checked()
    bench.check.begin(fresh=True)
    bench.check.record_plain_reply()
    bench.questions_within(1000)
    assert bench.check.state == "plain"


def test_an_unsent_plain_question_leaves_the_question_before_it_valid() -> None:
    bench = Bench()
    plain, question, again = bench.questions_within(200)
    assert [kind(line) for line in (plain, question, again)] == ["plain", "checked", "plain"]
    bench.check.settle(False)
    bench.reply(sequence_of(question))


def test_no_transition_leads_into_or_out_of_the_off_state() -> None:
    assert "off" not in {state for state, _ in TRANSITIONS} | set(TRANSITIONS.values())


# sequences


def test_sequences_count_up_and_start_over_after_255() -> None:
    bench = Bench().checked()
    first, *others = bench.drive(300)
    assert others == [(first + n) % 256 for n in range(1, 300)]


def test_only_the_last_line_can_be_marked_as_not_sent() -> None:
    bench = Bench().checked()
    first, second = bench.drive(2)
    bench.check.settle(False)
    bench.check.settle(False)
    assert bench.stale(second)
    bench.reply(first)


def test_a_late_answer_is_stale_even_while_newer_lines_wait() -> None:
    bench = Bench().checked()
    (old,) = bench.drive()
    bench.now_ns += ANSWER_TIMEOUT_NS + 1
    (new,) = bench.drive()
    assert bench.stale(old)
    bench.reply(new)


def test_each_sequence_is_accepted_once() -> None:
    bench = Bench().checked()
    (sequence,) = bench.drive()
    bench.reply(sequence)
    assert bench.stale(sequence)


def test_answers_to_pipelined_lines_are_accepted_in_order() -> None:
    bench = Bench().checked()
    for sequence in bench.drive(10):
        bench.now_ns += 5 * MS
        bench.reply(sequence)


def test_an_answer_makes_earlier_sequences_stale() -> None:
    bench = Bench().checked()
    first, second, third = bench.drive(3)
    bench.reply(second)
    assert bench.stale(first)
    bench.reply(third)


def test_an_answer_is_accepted_up_to_the_time_limit_and_stale_after_it() -> None:
    bench = Bench().checked()
    assert ANSWER_TIMEOUT_NS == 300 * MS  # the timeout of the MCU's own watchdog
    first, second = bench.drive(2)
    bench.now_ns += ANSWER_TIMEOUT_NS
    bench.reply(first)
    bench.now_ns += 1
    assert bench.stale(second)


def test_only_the_lines_within_the_window_can_be_answered() -> None:
    bench = Bench().checked()
    sequences = bench.drive(MAX_OPEN_LINES + 1)
    assert bench.stale(sequences[0])
    bench.reply(sequences[1])


def test_a_new_negotiation_forgets_the_lines_that_were_sent_before() -> None:
    bench = Bench().checked()
    (sequence,) = bench.drive()
    bench.check.begin()
    assert bench.stale(sequence)


@given(st.lists(st.integers(-1, 7), max_size=400))
def test_no_sequence_is_accepted_twice_or_out_of_order(skips: list[int]) -> None:
    bench = Bench().checked()
    sent: list[int] = []
    answered: set[int] = set()
    for number, skip in enumerate(skips):
        sent += bench.drive()
        if skip >= 0:
            at = max(0, number - skip)
            if not bench.stale(sent[at]):
                assert at not in answered
                assert all(at > other for other in answered)
                answered.add(at)


# samples


def test_an_answer_with_a_sample_keeps_samples_requested() -> None:
    bench = Bench(SAMPLES).checked(READING)
    assert bench.check.in_force == "checked with samples"
    assert kind(bench.check.seal(GO, bench.now_ns)) == "sampled"


def test_an_answer_without_a_sample_ends_the_sample_requests() -> None:
    bench = Bench(SAMPLES).checked()
    assert bench.check.in_force == "checked"
    assert kind(bench.check.seal(GO, bench.now_ns)) == "checked"


def test_samples_that_stop_coming_are_no_longer_requested() -> None:
    bench = Bench(SAMPLES).checked(READING)
    for _ in range(MAX_REPLIES_WITHOUT_SAMPLE - 1):
        bench.reply(bench.drive()[0])
    bench.reply(bench.drive()[0], READING)
    for _ in range(MAX_REPLIES_WITHOUT_SAMPLE):
        assert bench.check.in_force == "checked with samples"
        bench.reply(bench.drive()[0])
    assert bench.check.in_force == "checked"


@pytest.mark.parametrize("mcu", [AUTO, SAMPLES, REQUIRE])
def test_a_new_negotiation_is_not_checked_yet(mcu: McuConfig) -> None:
    assert Bench(mcu).check.in_force == "not checked yet"


def test_the_pace_of_questions_is_bounded() -> None:
    assert SILENT_BOARD_PERIOD_NS == 100 * MS
    bench = Bench(REQUIRE)
    bench.check.record_plain_reply()
    assert len(bench.questions_within(1000)) <= 25


def test_an_echo_of_a_question_is_reported_and_ends_no_negotiation() -> None:
    for mcu in (AUTO, REQUIRE, SAMPLES):
        bench = Bench(mcu)
        bench.check.record_plain_reply()
        for _ in range(50):
            for line in bench.questions_within():
                assert bench.check.check_question_echo(line[:-2])
        assert (bench.check.asking, bool(bench.check.trouble)) == (True, True)
        assert bench.check.trouble == "echo"
        bench.check.begin(fresh=True)
        assert not bench.check.trouble


@pytest.mark.parametrize("mcu", [AUTO, REQUIRE, SAMPLES])
def test_an_echo_that_comes_after_later_questions_is_reported(mcu: McuConfig) -> None:
    """A radio link may return each line 0.2 s later, when the next questions are sent already."""
    bench = Bench(mcu)
    bench.check.record_plain_reply()
    lines = [line[:-2] for line in bench.questions_within(1000)]
    with_letters = next(line for line in lines if has_request(line))
    assert len(lines) > 2
    assert bench.check.check_question_echo(with_letters)


def test_an_answer_is_not_an_echo() -> None:
    bench = Bench()
    (_, question) = bench.questions_within(110)
    answer = question.replace(b"H", b"")[:-2]
    assert not bench.check.check_question_echo(answer)


def test_the_throttle_lets_the_first_line_through_at_any_time() -> None:
    assert Throttle().lets(0, 100)
    assert Throttle().lets(-(10**18), 100)


def test_the_throttle_lets_the_next_line_through_only_after_the_wait() -> None:
    throttle = Throttle()
    assert [throttle.lets(at, 100) for at in (7, 8, 106, 107, 206, 207)] == [
        True, False, False, True, False, True,
    ]  # fmt: skip


def test_a_line_that_the_throttle_held_back_does_not_prolong_the_wait() -> None:
    throttle = Throttle()
    throttle.lets(0, 100)
    assert not throttle.lets(99, 100)
    assert throttle.last_ns == 0
    assert throttle.lets(100, 100)


def test_undoing_a_line_that_was_not_sent_restores_the_earlier_wait() -> None:
    throttle = Throttle()
    assert throttle.lets(0, 100)
    throttle.undo()
    assert throttle.lets(1, 100)
    assert throttle.lets(101, 100)
    throttle.undo()
    assert [throttle.lets(at, 100) for at in (100, 101)] == [False, True]


@given(st.lists(st.integers(0, 50), max_size=60), st.integers(1, 100))
def test_any_two_lines_that_the_throttle_lets_through_are_the_wait_apart(
    steps: list[int], wait_ns: int
) -> None:
    throttle, now_ns, times = Throttle(), 0, []
    for step in steps:
        now_ns += step
        if throttle.lets(now_ns, wait_ns):
            times.append(now_ns)
    assert all(b - a >= wait_ns for a, b in pairwise(times))
