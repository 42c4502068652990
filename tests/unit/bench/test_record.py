"""Tests of the conclusions that a benchmark draws from its record."""

from __future__ import annotations

import pytest

from acsard.bench.far_end import NumberedMcu
from acsard.bench.matching import Fed, lines_of, staircase
from acsard.bench.record import Record, Sample, Seen, Sent, command_waits, feedback_fates
from acsard.config.settings import Config, McuConfig, WheelMap
from acsard.mcu.codec import Codec
from acsard.values import Instant, WheelSpeeds

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
def test_each_answer_says_the_next_speed_forward_on_every_wheel(wheels: WheelMap) -> None:
    config = Config(mcu=McuConfig(wheels=wheels))
    codec = Codec(wheels)
    lines = lines_of(said_by_the_mcu(config, 20))
    assert len(lines) == 20
    for number, (_, line) in enumerate(lines, 1):
        speed = staircase(number)
        assert codec.decode(line) == WheelSpeeds(speed, speed, speed, speed)


def test_only_lines_between_start_and_end_count() -> None:
    config = Config()
    said = said_by_the_mcu(config, 10)
    first_ns, last_ns = said[3][0], said[7][0]
    samples = [
        Sample(Instant(at_ns + 5, 0), 0, staircase(number) * config.drive.wheel_radius)
        for number, (at_ns, _) in enumerate(said, 1)
    ]
    record = Record(0, (first_ns, last_ns), Seen(said=said), [], samples)
    assert record.said == [(at_ns, line.strip()) for at_ns, line in said[3:7]]
    assert feedback_fates(config, record) == [Fed(5, 0)] * 4


def test_a_command_is_found_on_the_wire() -> None:
    record = Record(0, (0, 100), Seen(heard=[(5, b"\r\nap"), (9, b"1\r\n")]), [Sent(4, b"x")], [])
    assert command_waits(record) == []
    heard = Seen(heard=[(5, b"\r\n"), (7, b"ap1,\r\n")])
    assert command_waits(Record(0, (0, 100), heard, [Sent(4, b"ap1")], [])) == [3]


def test_of_a_real_port_nothing_is_known() -> None:
    record = Record(0, (0, 100), None, [Sent(4, b"x")], [])
    assert not record.said
    assert not command_waits(record)
    assert not feedback_fates(Config(), record)
