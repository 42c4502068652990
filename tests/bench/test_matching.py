"""A benchmark matches commands, lines and samples by their values, and computes its figures."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import Config, McuConfig, WheelMap
from acsard.core.link.codec import Codec
from acsard.core.values import WheelSpeeds
from tests.bench.far_end import NumberedMcu
from tests.bench.matching import (
    CYCLE_LENGTH,
    LOSS_TIMEOUT_NS,
    MatchedLine,
    Record,
    RecordedTraffic,
    Sample,
    SentCommand,
    command_waits,
    commands_to_lines,
    feedback_fates,
    lines_of,
    lines_to_samples,
    staircase,
)

ONE, TWO = b"ap05.00,bp05.00,cp05.00,dp05.00", b"ap05.02,bp05.02,cp05.02,dp05.02"


def test_the_speeds_of_one_round_all_differ_and_fit_the_line() -> None:
    speeds = [staircase(number) for number in range(CYCLE_LENGTH)]
    assert len({f"{speed:05.2f}" for speed in speeds}) == CYCLE_LENGTH
    assert all(0.0 < speed < 20.0 for speed in speeds)


def test_neighbouring_speeds_are_close_also_from_one_round_to_the_next() -> None:
    speeds = [staircase(number) for number in range(2 * CYCLE_LENGTH + 1)]
    assert max(abs(b - a) for a, b in pairwise(speeds)) < 0.03


def test_a_line_has_the_time_of_its_first_byte() -> None:
    assert lines_of([(10, b"\r\nap1"), (20, b"2\r\nbp"), (30, b"\n")]) == [
        (10, b"ap12"),
        (20, b"bp"),
    ]


def test_a_line_may_end_with_a_comma() -> None:
    assert lines_of([(1, ONE + b",\r\n")]) == [(1, ONE)]


def test_bytes_without_a_line_end_are_not_a_line() -> None:
    assert lines_of([(1, ONE)]) == []


@given(st.lists(st.integers(1, 40), max_size=20))
def test_lines_are_the_same_however_the_stream_is_divided(cuts: list[int]) -> None:
    stream, chunks = (ONE + b"\r\n" + TWO + b"\r\n") * 3, []
    at = 0
    for number, cut in enumerate([*cuts, len(stream)]):
        chunks.append((number, stream[at : at + cut]))
        at += cut
    assert [line for _, line in lines_of(chunks)] == [ONE, TWO] * 3


def test_a_command_is_timed_to_the_first_line_with_its_speed() -> None:
    lines = [(90, ONE), (150, TWO), (160, ONE), (170, ONE)]
    assert commands_to_lines([(100, ONE)], lines) == [60]


def test_a_command_without_a_line_in_time_is_left_out() -> None:
    assert commands_to_lines([(100, ONE)], []) == []
    assert commands_to_lines([(100, ONE)], [(99, ONE)]) == []
    assert commands_to_lines([(100, ONE)], [(100 + LOSS_TIMEOUT_NS, ONE)]) == []


def test_a_sample_is_timed_from_the_line_with_its_speed() -> None:
    lines = [(10, 0.25), (20, 0.251), (30, 0.252)]
    assert lines_to_samples(lines, [(15, 0.25), (25, 0.251)]) == [
        MatchedLine(5, 0),
        MatchedLine(5, 0),
    ]


def test_newer_lines_are_counted_as_waiting() -> None:
    lines = [(10, 0.25), (20, 0.251), (30, 0.252)]
    assert lines_to_samples(lines, [(35, 0.25), (36, 0.252)]) == [
        MatchedLine(25, 2),
        MatchedLine(6, 0),
    ]


def test_a_sample_that_repeats_a_line_or_matches_no_line_is_left_out() -> None:
    lines = [(10, 0.25), (20, 0.251)]
    assert lines_to_samples(lines, [(12, 0.25), (14, 0.25), (22, 0.7), (5, 0.251)]) == [
        MatchedLine(2, 0)
    ]


def test_the_same_speed_a_round_later_is_another_line() -> None:
    lines = [(number * 10, staircase(number) / 20) for number in range(2 * CYCLE_LENGTH)]
    samples = [(at_ns + 3, speed) for at_ns, speed in lines]
    assert lines_to_samples(lines, samples) == [MatchedLine(3, 0)] * (2 * CYCLE_LENGTH)


def test_a_speed_is_recognised_in_spite_of_rounding() -> None:
    assert lines_to_samples([(0, 0.1 + 0.2)], [(1, 0.3)]) == [MatchedLine(1, 0)]


MS = 1_000_000

WIRINGS = [WheelMap(), WheelMap("-d", "+c", "-b", "+a")]


def said_by_the_mcu(config: Config, count: int) -> list[tuple[int, bytes]]:
    """Return the replies of the numbered microcontroller to `count` lines that are 10 ms apart."""
    mcu, stop = NumberedMcu(config, 0), Codec(config.mcu.wheels).stop
    chunks = []
    for now_ms in range(10 * count + 30):
        if now_ms % 10 == 0 and now_ms < 10 * count:
            mcu.receive(now_ms * MS, stop)
        data = mcu.advance(now_ms * MS)
        if data:
            chunks.append((now_ms * MS, data))
    return chunks


@pytest.mark.parametrize("wheels", WIRINGS)
def test_each_reply_has_the_next_speed_forward_on_every_wheel(wheels: WheelMap) -> None:
    config = Config(mcu=McuConfig(wheels=wheels))
    codec = Codec(wheels)
    lines = lines_of(said_by_the_mcu(config, 20))
    assert len(lines) == 20
    for number, (_, line) in enumerate(lines, 1):
        speed = staircase(number)
        assert codec.decode(line) == WheelSpeeds(speed, speed, speed, speed)


def test_only_lines_between_start_and_end_count() -> None:
    config = Config()
    lines = said_by_the_mcu(config, 10)
    first_ns, last_ns = lines[3][0], lines[7][0]
    samples = [
        Sample(at_ns + 5, staircase(number) * config.drive.wheel_radius)
        for number, (at_ns, _) in enumerate(lines, 1)
    ]
    record = Record((first_ns, last_ns), RecordedTraffic(to_daemon=lines), [], samples)
    assert record.feedback_lines == [(at_ns, line.strip()) for at_ns, line in lines[3:7]]
    assert feedback_fates(config, record) == [MatchedLine(5, 0)] * 4


def test_a_command_is_found_on_the_wire() -> None:
    record = Record(
        (0, 100),
        RecordedTraffic(from_daemon=[(5, b"\r\nap"), (9, b"1\r\n")]),
        [SentCommand(4, b"x")],
        [],
    )
    assert command_waits(record) == []
    traffic = RecordedTraffic(from_daemon=[(5, b"\r\n"), (7, b"ap1,\r\n")])
    assert command_waits(Record((0, 100), traffic, [SentCommand(4, b"ap1")], [])) == [3]
