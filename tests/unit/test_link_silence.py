"""Why a link is down: what the board sent instead, or a delay of this computer."""

from __future__ import annotations

import random
from itertools import cycle, islice
from time import process_time_ns

from acsard.core.config.settings import McuConfig
from acsard.core.link.lines import MAX_LINE_BYTES, LineReader
from acsard.core.link.link_diagnosis import (
    FIRST_DIAGNOSIS_NS,
    MAX_UNANSWERED_FRACTION,
    WINDOW_LINES,
    SilenceDiagnosis,
    Traffic,
    UnansweredLines,
    describe_state,
)
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import LinkState
from acsard.core.link.step_times import StepTimes
from tests.each import each
from tests.unit.link_bench import GOOD, MS, STOP, LinkBench

BOARD = McuConfig(port="/dev/board")
SIMULATED, REAL = (LinkSetup.of(McuConfig(port=port), 100.0) for port in ("sim", "/dev/board"))

HEARD: dict[str, tuple[bytes, str, str]] = {
    "mute": (b"", "nothing", "nothing was received"),
    "half lines": (
        b"ap00.00,bp00.00,c" * 9,
        "cut",
        "153 bytes received but no line end; the last bytes are `",
    ),
    "cut lines": (b"ap00.00,bp0\r\n" * 4, "cut", "none good, the last one is `ap00.00,bp0`"),
    "noise": (
        (b"\x00\xff~" + STOP) * 144,
        "foreign",
        r"lines received, none good, the last one is `\x00\xff~ap00.00,bp00.00,cp00.00,dp00.00`",
    ),
    "torn by a status line": (
        b"ap00.00,bp00.00,!status volts=24.68 amps=-0.50\r\n", "garbage", "none good"
    ),
    "cut behind three values": (b"ap00.00,bp00.00,cp00.00\r\n", "cut", "none good"),
    "wrong baud rate": (b"\xf8\x00\xe6\n\x9e" * 3, "garbage", "3 lines received, none good"),
    "no end": (
        b"\xf8\x00\xe6" * 3, "garbage", r"the last bytes are `\xf8\x00\xe6\xf8\x00\xe6\xf8\x00\xe6`"
    ),
    "text": (
        b"[I][main] heap 182344\r\n" * 3 + STOP, "text",
        "4 lines received, only 1 good, the last bad one is `[I][main] heap 182344`"
    ),
    "another form": (b"ap 0.00,bp 0.00,cp 0.00,dp 0.00\r\n", "form", "none good"),
    "two other motors": (b"rp12.50,lp08.75,\r\n", "letters", "none good"),
    "a board of two": (b"ap12.50,bn08.75\r\n", "letters", "none good"),
    "four other motors": (b"ep00.00,fp00.00,gp00.00,hp00.00#07*0000\r\n", "letters", "none good"),
    "a motor twice": (b"ap00.00,ap00.00,bp00.00,dp00.00\r\n", "letters", "none good"),
    "three values": (b"ap00.00,bp00.00,cp00.00\r\n" * 4, "cut", "none good"),
    "a wrong check": (b"ap00.00,bp00.00,cp00.00,dp00.00#07*0000\r\n", "foreign", "none good"),
    "two motors": (b"lp00.00,rp00.00\r\n", "letters", "the last one is `lp00.00,rp00.00`"),
    "two motors, with checks": (b"lp00.00,rp00.00#07*585F\r\n", "letters", "none good"),
    "a boot": (
        b"ets Jul 29 2019 12:21:46\r\n\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\n"
        b"load:0x3fff0030,len:1184\r\n", "boot", "the last one is `load:0x3fff0030,len:1184`"
    ),
    "a low supply": (
        b"Brownout detector was triggered\r\n\r\nrst:0xf (RTCWDT_BROWN_OUT_RESET)\r\n"
        b"entry 0x400805e4\r\n", "brownout", "none good"
    ),
    "a GPS receiver": (
        b"$GPGGA,123519.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n", "nmea",
        "1 line received, none good"
    ),
    "some good": (
        STOP + b"ap?\r\n", "few", "2 lines received, only 1 good, the last bad one is `ap?`"
    ),
    "all good": (STOP * 2, "sparse", "2 lines received, all of them good, but too few for a link"),
}  # fmt: skip


STOP_OF_TWO = b"lp00.00,rp00.00\r\n"
HEARD_OF_TWO: dict[str, tuple[bytes, str, str]] = {
    "half lines": (b"lp00.00,r" * 9, "cut", "81 bytes received but no line end"),
    "cut lines": (b"lp00.00,r\r\n" * 4, "cut", "none good, the last one is `lp00.00,r`"),
    "noise": ((b"\x00\xff~" + STOP_OF_TWO) * 144, "foreign", "none good"),
    "wrong baud rate": (b"\xf8\x00\xe6\n\x9e" * 3, "garbage", "3 lines received, none good"),
    "text": (b"[I][main] heap 182344\r\n" * 3 + STOP_OF_TWO, "text", "only 1 good"),
    "another form": (b"lp 0.00,rp 0.00\r\n", "form", "none good"),
    "four motors": (STOP, "letters", "the last one is `ap00.00,bp00.00,cp00.00,dp00.00`"),
    "other motors": (b"ap00.00,bp00.00\r\n", "letters", "none good"),
    "one motor twice": (b"lp00.00,lp00.00\r\n", "letters", "none good"),
    "some good": (STOP_OF_TWO + b"lp?\r\n", "few", "the last bad one is `lp?`"),
    "all good": (STOP_OF_TWO * 2, "sparse", "2 lines received, all of them good"),
}


@each(
    ("stop", "data", "looks", "counted"),
    [
        *((STOP, *row) for row in HEARD.values()),
        *((STOP_OF_TWO, *row) for row in HEARD_OF_TWO.values()),
    ],
)
def test_the_diagnosis_says_what_was_received_and_how_it_looks(
    stop: bytes, data: bytes, looks: str, counted: str
) -> None:
    heard = Traffic()
    heard.take(data)
    for line, _ in LineReader().feed(data):
        heard.line(line, line + b"\r\n" == stop, stop[::8].decode().strip())
    assert heard.code == heard.diagnosis().code == f"received_{looks}"
    assert counted in heard.counted
    assert heard.counted in heard.diagnosis().text


@each(
    ("heard", "remedy"),
    [
        ("a board of two", 'write right = "+a", left = "+b" into [mcu.wheels]'),
        ("two other motors", 'write left = "+l", right = "+r" into [mcu.wheels]'),
        (
            "four other motors",
            'front_left = "+f", rear_left = "+g", rear_right = "+h", right = ""',
        ),
        ("a motor twice", "the firmware must name each motor once"),
    ],
)
def test_a_board_of_other_motors_is_answered_with_the_lines_to_write(
    heard: str, remedy: str
) -> None:
    traffic = Traffic()
    data, _, _ = HEARD[heard]
    traffic.take(data)
    traffic.line(data.rstrip(), False, "abcd")
    assert remedy in traffic.diagnosis().text


def test_no_line_that_the_board_can_send_takes_long_to_classify() -> None:
    """The control loop classifies the lines: one that takes long would stop the wheels."""

    def cost(line: bytes) -> int:
        def once() -> int:
            start = process_time_ns()
            for _ in range(5):
                Traffic().line(line, False, "abcd")
            return process_time_ns() - start

        return min(once() for _ in range(3))

    most = MAX_LINE_BYTES - 1
    plain = cost(b"x" * most)
    dice = random.Random(1)
    for size in islice(cycle(range(16, most)), 1500):
        part, rest = divmod(size - 1, 4)
        pattern = dice.choices([b" ", b"1", b".1", b"p", b"= ", b",", b""], k=4)
        run = dice.choice([b"1", b" ", b"1 ", b"=", b","]) * part
        groups = (bytes([wheel]) + (pattern[0] + run + b"".join(pattern[1:])) for wheel in b"abcd")
        spaced = (bytes([wheel]) + b" " * (part // 2) + b"1" * (part // 2) for wheel in b"abcd")
        for line in (b"".join(groups) + b"x" * rest, b"".join(spaced) + b"x"):
            assert cost(line[:most]) < 20 * plain, line[:most]


def test_it_comes_after_three_seconds_and_again_only_when_it_changes() -> None:
    silence, reports = SilenceDiagnosis(), []
    for tick in range(100):
        if tick > 50:
            silence.now.take(b"\x00")
        if silence.diagnose(tick * FIRST_DIAGNOSIS_NS // 10):
            assert silence.complete is not None
            reports.append((tick, silence.complete.code))
    assert reports == [(10, "received_nothing"), (60, "received_garbage")]
    silence.now.line(STOP, True, "abcd")
    silence.forget()
    assert (silence.complete, silence.now) == (None, Traffic())
    assert not silence.diagnose(10 * FIRST_DIAGNOSIS_NS)


@each(
    ("apart", "longest", "code"),
    [
        (20, 0.25, "reply_period"),
        (20, 0.15, "lines_too_rare"),
        (74, 0.25, "lines_too_rare"),
        (136, 0.25, "lines_too_rare"),
    ],
)
def test_lines_too_far_apart_are_reported_with_a_setting_only_if_it_is_valid(
    apart: int, longest: float, code: str
) -> None:
    bench = LinkBench(BOARD, longest_reply=longest).open()
    for tick in range(600):
        bench.wait(10, *([] if tick % apart else [GOOD]))
    assert bench.why.code == code
    bench = LinkBench(BOARD).up()  # a single silence proves nothing
    bench.waits(20)
    bench.wait(10, GOOD)
    assert (bench.link, bench.why.code) == ("stale", "link_silent")


# delays of this computer


def after(*steps_ms: int, good: bool = False) -> StepTimes:
    """Check the lateness after each of these time steps. A good line arrives at time 0.

    `good` says whether another good line arrives in the last step.
    """
    steps, now_ns = StepTimes(0), 0
    steps.end_silence(REAL, good=True)
    for number, step_ms in enumerate(steps_ms, 1):
        now_ns += step_ms * MS
        steps.begin(REAL, now_ns)
        steps.end_silence(REAL, good=good and number == len(steps_ms))
    return steps


@each(
    ("steps", "good", "late_s", "code"),
    [
        ([10] * 11, False, 0.0, "link_silent"),
        ([49] * 3, False, 0.0, "link_silent"),
        ([800], False, 0.8, "host_late"),
        ([10, 800, 10], False, 0.8, "host_late"),
        ([60, 800], False, 0.8, "host_late"),
        ([800, 10], True, 0.0, "link_silent"),
        ([800], True, 0.0, "link_silent"),
    ],
)
def test_a_stale_link_is_blamed_on_the_board_unless_the_host_was_late(
    steps: list[int], good: bool, late_s: float, code: str
) -> None:
    times = after(*steps, good=good)
    assert (times.late_s, describe_state(REAL, "stale", times).code) == (late_s, code)
    states: list[LinkState] = ["up", "booting", "down"]
    assert [describe_state(REAL, state, times).code for state in states] == [
        "link_up", "booting", "port_closed",
    ]  # fmt: skip


@each(("port", "code"), [("sim", "simulator_fault"), ("/dev/board", "link_silent")])
def test_lines_that_the_host_read_late_give_no_advice_about_the_board(port: str, code: str) -> None:
    bench, codes = LinkBench(McuConfig(port=port)).up(), set()
    for _ in range(20):  # a step late, which finds the bytes that arrived meanwhile
        bench.wait(300)
        codes.add(bench.why.code)
        bench.wait(10, GOOD)
        codes.add(bench.why.code)
    assert codes == {"host_late", code}


# lines without an answer


def events_of(every: int, period: float = 0.0, linked: bool = True) -> list[str]:
    """Return the events of a link that loses every n-th line."""
    answered = UnansweredLines()
    events = [
        answered.check(sent, sent - sent // every if every else sent, linked, period)
        for sent in range(3 * WINDOW_LINES + 1)
    ]
    return [event.text for event in events if event is not None]


def test_a_loss_of_a_fifth_of_the_lines_is_reported_once_with_its_figures() -> None:
    (text,) = events_of(5)
    assert f"answered only {WINDOW_LINES * 4 // 5} of {WINDOW_LINES} lines" in text
    assert events_of(0) == events_of(int(1 / MAX_UNANSWERED_FRACTION) + 1) == []
    # Not for a free-running board or without a link, and again after the link was down.
    assert events_of(5, period=0.1) == events_of(5, linked=False) == []
    answered = UnansweredLines()
    events = [
        answered.check(sent, sent // 2, sent != WINDOW_LINES + 10, 0.0)
        for sent in range(3 * WINDOW_LINES)
    ]
    assert len([event for event in events if event]) == 2
