"""Tests that match each reply to the line it answers by order and delay."""

from __future__ import annotations

import random
from statistics import mode

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.sample_time import PromptedTimes
from tests.each import each

MS = 1_000_000
DELAY_MS = 9.0


class Bench:
    """A sequence of sent lines and received replies."""

    def __init__(self) -> None:
        self.prompts = PromptedTimes(soonest_ns=6 * MS)

    def leave(self, ms: float) -> None:
        self.prompts.left(int(ms * MS))

    def reply(self, ms: float, lines: int = 1, asked_ms: float | None = None) -> list[float]:
        """Read this many replies; return the dt and the filled gap of each, in ms."""
        self.prompts.read(int(ms * MS), lines)
        said = []
        for _ in range(lines):
            asked = None if asked_ms is None else int(asked_ms * MS)
            answered = self.prompts.place(asked)
            assert answered is not None
            said += [round((answered.dt or 0.0) * 1000, 3), round(answered.bridged * 1000, 3)]
        return said

    def talk(self, count: int = 20) -> Bench:
        """Send a line every 10 ms and answer each; the last one leaves at (count - 1) x 10."""
        for number in range(count):
            self.leave(number * 10)
            self.reply(number * 10 + DELAY_MS)
        return self


def test_a_reply_that_no_line_waits_for_has_no_line() -> None:
    prompts = PromptedTimes(0)
    prompts.read(10 * MS, 1)
    assert prompts.place() is None


def test_replies_are_as_far_apart_as_their_lines() -> None:
    bench = Bench().talk()
    bench.leave(203.0)
    assert bench.reply(203.0 + DELAY_MS) == [13.0, 0.0]


def test_where_no_line_left_nothing_is_missing() -> None:
    bench = Bench().talk()
    bench.leave(440.0)
    assert bench.reply(440.0 + DELAY_MS) == [250.0, 0.0]


def test_a_stall_of_the_read_changes_nothing() -> None:
    bench = Bench().talk()
    bench.leave(200.0)
    bench.leave(410.0)
    assert bench.reply(410.5) == [10.0, 0.0]
    assert bench.reply(410.0 + DELAY_MS) == [210.0, 0.0]


def test_a_lost_reply_leaves_its_line_without_one() -> None:
    bench = Bench().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS) == [20.0, 10.0]


def test_a_damaged_reply_leaves_its_line_without_one() -> None:
    bench = Bench().talk()
    bench.leave(200.0)
    bench.prompts.read(int((200.0 + DELAY_MS) * MS), 1)
    bench.prompts.skip()
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS) == [20.0, 10.0]


def test_a_line_given_up_too_early_gets_its_reply_back() -> None:
    bench = Bench()
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


def test_a_late_answer_is_none_that_comes_sooner_than_any() -> None:
    bench = Bench().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS - 1) == [10.0, 0.0]
    assert bench.reply(210.0 + DELAY_MS) == [10.0, 0.0]


def test_of_two_lines_that_leave_at_once_behind_a_stall_none_is_lost() -> None:
    """No gap is filled, because the answer to the first line, read late, covers the whole stall."""
    bench = Bench().talk()
    bench.leave(400.0)
    bench.leave(403.0)
    assert bench.reply(403.0 + DELAY_MS + 0.2) == [210.0, 0.0]
    assert bench.reply(403.0 + DELAY_MS + 3.0)[1] == 0.0


def test_a_silence_that_begins_with_two_close_lines_leaves_all_of_its_lines_without() -> None:
    """No earlier line's answer can be so late that the second line's own answer would be due."""
    bench = Bench().talk()
    for ms in (200.0, 203.9, 220.0, 320.0, 420.0, 520.0, 620.0):
        bench.leave(ms)
    assert bench.reply(620.0 + DELAY_MS) == [430.0, 330.0]
    bench.leave(630.0)
    assert bench.reply(630.0 + DELAY_MS) == [10.0, 0.0]


def test_where_answers_get_lost_one_of_two_close_lines_may_be_without() -> None:
    bench = Bench().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    assert bench.reply(210.0 + DELAY_MS) == [20.0, 10.0]
    bench.leave(400.0)
    bench.leave(403.0)
    assert bench.reply(403.0 + DELAY_MS + 0.2) == [193.0, 190.0]


def test_where_a_reply_says_its_line_nothing_is_guessed() -> None:
    bench = Bench().talk()
    bench.leave(200.0)
    bench.leave(210.0)
    bench.leave(220.0)
    assert bench.reply(500.0, asked_ms=210.0) == [20.0, 10.0]
    assert bench.reply(500.0, asked_ms=220.0) == [10.0, 0.0]


def test_a_board_that_thinks_for_1_to_5_ms_samples_as_late_where_replies_name_their_lines() -> None:
    bench, before = Bench(), 0.0
    late = (2.1, 1.3, 3.7, 1.0, 4.9, 2.6, 1.8, 3.2)
    for number in range(400):
        thought = late[number % len(late)]
        bench.leave(number * 10)
        dt, _ = bench.reply(number * 10 + 6 + thought, asked_ms=number * 10)
        if number > 100:
            assert dt == pytest.approx(10 + thought - before, abs=0.5)
        before = thought


def test_the_first_reply_answers_the_newest_line_that_it_can() -> None:
    bench = Bench()
    for number in range(10):
        bench.leave(number * 10)
    bench.reply(97.0)
    bench.leave(100.0)
    assert bench.reply(107.0) == [10.0, 0.0]


@given(seed=st.integers(0, 10_000))
def test_without_loss_the_dts_add_up_to_the_time_between_the_lines(seed: int) -> None:
    chance = random.Random(seed)
    bench = Bench().talk()
    at = total = 190.0
    for _ in range(200):
        at += chance.choice([10.0, 10.0, 10.0, 4.0, 90.0])
        bench.leave(at)
        dt, _ = bench.reply(at + DELAY_MS)
        assert dt >= 0.0
        total += dt
    assert total == pytest.approx(at, abs=0.1)


def test_a_new_session_begins_without_a_past() -> None:
    bench = Bench().talk()
    bench.prompts.forget()
    bench.leave(500.0)
    assert bench.reply(500.0 + DELAY_MS) == [0.0, 0.0]


# an adapter that delivers answers in batches


def batched(
    bench: Bench, seed: int, lines: int, lost: tuple[int, ...] = (), offs: list[int] | None = None
) -> float:
    """Return the time that batched answers cover after the first second, ms.

    Lines are sent every 10 ms, and their answers arrive every 16 ms.

    `offs` collects the distance from each reply's own line to the line it was matched to, up to a
    constant.
    """
    chance, told = random.Random(seed), 0.0
    answers, leaves = [i for i in range(lines) if i not in lost], list(range(lines))
    for batch in range(1, lines * 10 // 16 + 3):
        at = batch * 16.0 + chance.uniform(0.0, 0.5)
        while leaves and leaves[0] * 10 < at:
            bench.leave(leaves.pop(0) * 10)
        ready = [i for i in answers if i * 10 + DELAY_MS <= batch * 16]
        answers = answers[len(ready) :]
        if ready:
            bench.prompts.read(int(at * MS), len(ready))
        for number in ready:
            answered = bench.prompts.place()
            if number > 100 and answered is not None:
                told += 1000 * (answered.dt or 0.0)
                if offs is not None:
                    offs.append(round(told / 10) - number)
    return told


@each("seed", range(5))
def test_of_a_batched_link_each_answer_has_its_line(seed: int) -> None:
    bench = Bench()
    assert batched(bench, seed, 300) == pytest.approx(1990.0, abs=0.1)
    assert not bench.prompts.lossy


@each("seed", range(5))
def test_an_answer_lost_on_a_batched_link_is_noticed_soon(seed: int) -> None:
    bench = Bench()
    assert batched(bench, seed, 300, lost=(150,)) == pytest.approx(1990.0, abs=0.1)


@each("seed", range(5))
def test_two_lost_answers_that_happen_to_be_near_each_other_leave_the_lines_their_clock(
    seed: int,
) -> None:
    bench = Bench()
    batched(bench, seed, 170, lost=(150, 153, 156))
    assert not bench.prompts.lossy


@pytest.mark.parametrize("seed", range(5))
def test_where_a_fifth_of_a_batched_link_is_lost_an_answer_is_of_its_batch(seed: int) -> None:
    bench, chance, offs = Bench(), random.Random(seed), list[int]()
    lost = tuple(number for number in range(1000) if chance.random() < 0.2)
    batched(bench, seed, 1000, lost, offs)
    assert bench.prompts.lossy
    usual = mode(offs)
    assert sum(off == usual for off in offs) > 0.8 * len(offs)
    assert {off - usual for off in offs} <= {-1, 0, 1}


def test_of_answers_that_take_1_to_5_ms_the_mcu_is_held_to_think() -> None:
    bench, chance = Bench(), random.Random(1)
    for number in range(300):
        bench.leave(number * 10)
        bench.reply(number * 10 + 7.0 + chance.uniform(0.0, 4.0))
    assert bench.prompts.thinks


def test_what_usb_makes_of_a_delay_is_no_thinking() -> None:
    bench, chance = Bench(), random.Random(1)
    for number in range(300):
        bench.leave(number * 10)
        bench.reply(number * 10 + 8.0 + chance.uniform(0.0, 1.0) + chance.expovariate(1 / 0.3))
    assert not bench.prompts.thinks
