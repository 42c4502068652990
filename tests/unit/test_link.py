"""The link to the board: when it is up, when a session begins anew, and the time of its lines."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.config.settings import FeedbackConfig, McuConfig
from acsard.core.config.wire_time import wire_ns
from acsard.core.link.feedback import MIN_INTERVAL_NS
from acsard.core.link.link_output import Output
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import Link
from acsard.core.link.session import LONG_GAP_NS, McuSession
from acsard.core.values import NS_PER_S, Instant, Received, WheelSpeeds
from tests.each import each
from tests.unit.link_bench import (
    BAD,
    BOOTED,
    CHECKED,
    GOOD,
    MS,
    PLAIN,
    STOP,
    WALL_NS,
    LinkBench,
)
from tests.vectors.lines import ZERO

FREE = McuConfig(reply_period=0.01)
NOISE = b"\x00\xf8~boot\r\n" + GOOD[:20]
LONG = b"x" * 200 + b"\r\n" + GOOD
QUIET_MS = LONG_GAP_NS / MS

Step = tuple[str, float, bytes, str]
"""What happens to the port, the ms that pass, the bytes that are read then, and the link after."""

OPENED: list[Step] = [("open", 10, b"", "booting")]
QUIET: list[Step] = [*[("", 50, b"", "up")] * 2, ("", 50, b"", "stale")]
ASKED: list[Step] = [*OPENED, ("", 10, GOOD, "booting"), ("", 10, b"", "booting")]
UP: list[Step] = [*ASKED, ("", 10, GOOD * 3, "up")]

LINKS: dict[str, list[Step]] = {
    "a closed port": [("", 10, b"", "down"), ("", 10, GOOD * 5, "down")],
    "the third good line": [*ASKED, *[("", 10, GOOD, "booting")] * 2, *[("", 10, GOOD, "up")] * 2],
    "no good line before the question counts": [*OPENED, ("", 10, GOOD * 9, "booting")],
    "a bad line while booting starts the count again": [
        *ASKED, ("", 10, GOOD + GOOD + BAD + GOOD + GOOD, "booting"), ("", 10, GOOD, "up"),
    ],
    "a line that is too long starts the count again": [*OPENED, *[("", 10, LONG, "booting")] * 4],
    "a board that prints noise": [*OPENED, *[("", 10, NOISE, "booting")] * 100],
    "silences between good lines": [*OPENED, *[("", 150, GOOD, "booting")] * 10],
    "bad lines among good ones": [*UP, *[("", 10, BAD + BAD + GOOD + BAD, "up")] * 100],
    "quiet": [*UP, *[("", 50, b"", "up")] * 2, ("", 0.000001, b"", "stale")],
    "quiet behind a late step": [
        *UP, ("", 100, b"", "up"), ("", 33, b"", "up"), ("", 1, b"", "stale"),
    ],
    "an answer behind a late step": [*UP, *[("", 150, b"", "up"), ("", 20, GOOD, "up")] * 3],
    "late steps one after another": [*UP, ("", 90, b"", "up"), ("", 90, b"", "stale")],
    "a step so late that the board stops": [*UP, ("", 300, b"", "stale")],
    "bad lines alone": [*UP, *[("", 10, BAD, "up")] * 10, ("", 10, BAD, "stale")],
    "a stale link, and three good lines": [
        *UP, *QUIET, *[("", 10, GOOD, "stale")] * 2, ("", 10, GOOD, "up"),
    ],
    "a stale link, and a port that closes": [*UP, *QUIET, ("close", 10, b"", "down")],
    "a board that restarts within one read": [
        *UP, ("", 30, GOOD, "up"), ("", 10, BOOTED + GOOD * 4, "booting"),
        *[("", 10, GOOD, "booting")] * 2,
        ("", 10, GOOD, "up"),
    ],
}  # fmt: skip
RESTARTS: dict[str, list[tuple[str, float, bytes, bool]]] = {
    "the port opens": [("", 10, b"", False), ("open", 10, b"", True), ("", 10, b"", False)],
    "the port closes and opens between two updates": [
        ("open", 10, GOOD * 3, True), ("", 10, b"", False), ("open", 10, GOOD, True),
    ],
    "the port closes": [("open", 10, GOOD * 3, True), ("close", 10, b"", False)],
    "the first line after a long gap": [
        ("open", 10, GOOD * 3, True), ("", QUIET_MS, b"", False), ("", 0, GOOD, True),
        ("", 10, GOOD, False),
    ],
    "a long gap that ends within a read": [
        ("open", 10, GOOD * 3, True), ("", 1500, GOOD + GOOD + BAD + GOOD, True),
    ],
    "a short gap": [("open", 10, GOOD * 3, True), ("", 999.999, GOOD, False)],
    "the first line ever": [("open", 10, b"", True), ("", 2000, GOOD, False)],
    # A zero that was sent while the board was silent must not arm its sender.
    "a late first line of a new session": [
        ("open", 10, GOOD * 3, True), ("open", 10, b"", True), ("", QUIET_MS, b"", False),
        ("", 0, GOOD, True),
    ],
    "a late first line of a board that restarted": [
        ("open", 10, GOOD * 4, True), ("", 10, b"", False), ("", 30, GOOD, False),
        ("", 30, BOOTED, True), ("", QUIET_MS, b"", False), ("", 0, GOOD, True),
    ],
}  # fmt: skip
"""What happens to the port, the ms that pass, the bytes read then, and whether it restarts."""


def happens(bench: LinkBench, port: str, ms: float, data: bytes) -> LinkBench:
    if port:
        bench.open() if port == "open" else bench.close()
    bench.wait(ms, *([data] if data else []))
    return bench


@each("case", LINKS)
def test_the_link_after_each_step(case: str) -> None:
    bench = LinkBench()
    for number, (port, ms, data, link) in enumerate(LINKS[case]):
        assert happens(bench, port, ms, data).link == link, number


@each("case", RESTARTS)
def test_a_session_restarts_with_the_port_and_after_a_long_gap(case: str) -> None:
    bench = LinkBench()
    for number, (port, ms, data, restarted) in enumerate(RESTARTS[case]):
        assert happens(bench, port, ms, data).session.restarted is restarted, number


# the state of the link


def test_lines_further_apart_than_the_silence_limit_make_no_link() -> None:
    link, sparse = Link(), []
    link.apply("opened")
    for number in range(12):
        link.good(number * 101 * MS, 100 * MS)
        link.decide_state(number * 101 * MS, True, False)
        assert link.state == "booting"
        sparse.append(link.sparse_s)
    assert (sparse[1], sparse[-1]) == (0.0, 0.101)  # a single one proves nothing
    link.good(12 * 101 * MS - 50 * MS, 100 * MS)
    assert link.sparse_s == 0.0


# the time of a line


def test_a_line_is_never_older_than_the_previous_line() -> None:
    bench = LinkBench(replace(FREE, baud_rate=9600)).open()
    (first,) = bench.wait(10, GOOD)
    (second,) = bench.wait(1, GOOD + GOOD[:20])  # 20.8 ms of wire time within 1 ms
    # The stamps must also differ. A reader of the transforms takes the second of two with one stamp
    # for an echo.
    assert second.at.mono_ns == first.at.mono_ns + MIN_INTERVAL_NS
    assert second.at.wall_ns == first.at.wall_ns + MIN_INTERVAL_NS
    assert second.dt == 0.0


def test_a_step_of_the_wall_clock_changes_no_dt() -> None:
    setup, session, out = LinkSetup.of(FREE, 100.0), McuSession(), Output()
    for step in range(1, 10):
        now = Instant(step * 10 * MS, WALL_NS + (-1) ** step * 3600 * NS_PER_S)
        (feedback,) = session.update(setup, out, now, True, 1, (Received(now, GOOD),))
        assert feedback.dt == (0.01 if step > 1 else 0.0)
        late_ns = now.mono_ns - feedback.at.mono_ns
        assert late_ns == now.wall_ns - feedback.at.wall_ns == wire_ns(len(GOOD), 115200)


@each(
    ("steps", "dt", "bridged", "gap"),
    [
        ([("", 100, b"")], 0.1, 0.09, 0.0),  # up to the silence limit
        ([("", 1200, b""), ("", 50, b"")], 0.0, 0.0, 1.25),
        ([("", 10, BAD)] * 15 + [("", 10, b"")], 0.16, 0.15, 0.0),  # bad lines are in their periods
        ([("", 500, GOOD), ("", 10, b"")], 0.01, 0.0, 0.0),  # the second one after a gap
        ([("close", 20, b""), ("open", 20, b"")], 0.0, 0.0, 0.04),
    ],
)
def test_the_time_and_the_gap_of_a_line(
    steps: list[tuple[str, float, bytes]], dt: float, bridged: float, gap: float
) -> None:
    bench = LinkBench(FREE).up()
    *before, (port, ms, _) = steps
    for step in before:
        happens(bench, *step)
    if port:
        bench.open()
    (feedback,) = bench.wait(ms, GOOD)
    assert (feedback.dt, feedback.bridged, feedback.gap) == (dt, bridged, gap)


# counting, and the configuration


@each("reads", [1, 4])
def test_the_bad_lines_of_an_update_make_one_event_for_each_reason(reads: int) -> None:
    bench = LinkBench().open()
    bench.wait(10)
    bench.wait(10, *([b"x\r\n" * 200 + b"ap99.99\r\n" + b"y" * 300 + b"\r\n"] * reads))
    rows = [(event.kind, event.count, event.text) for event in bench.session.events]
    assert rows == [("malformed", 201 * reads, "b'ap99.99'"), ("too_long", reads, "")]


# a board that names itself


@each("mcu", [PLAIN, CHECKED])
def test_a_board_that_names_itself_has_restarted(mcu: McuConfig) -> None:
    bench = LinkBench(mcu)
    bench.checked() if mcu is CHECKED else bench.up()
    bench.line()
    bench.wait(30, BOOTED)
    assert (bench.session.restarted, bench.link) == (True, "booting")
    assert bench.names == ["mcu_restarted", "link_booting"]
    assert bench.session.rejects == {}
    assert bench.line() == (None if mcu is CHECKED else STOP)  # without delay
    booting = LinkBench(mcu).open()  # while it still boots, that is no event
    booting.wait(10, BOOTED)
    assert (booting.session.restarted, booting.names) == (True, ["link_booting"])


# echoes


@each("mcu", [PLAIN, CHECKED, McuConfig(link_check="on", encoder_counts=3200)])
@each("board", [b"", GOOD])
def test_a_port_that_returns_the_question_is_never_linked(mcu: McuConfig, board: bytes) -> None:
    bench = LinkBench(mcu).open()
    bench.wait(10)
    lines = bench.echoed(1.0, 400, board)
    assert (bench.link, bench.why.code) == ("booting", "echo")
    assert all(line.startswith((ZERO, b"?")) for line in lines)
    bench.checked() if mcu.checked else bench.up()  # until the port is opened again


def test_a_returned_question_counts_only_while_an_answer_may_come() -> None:
    bench = LinkBench().up()
    bench.wait(1000, GOOD)
    bench.wait(10, b"?\r\n")
    assert (bench.link, bench.session.rejects) == ("up", {"echo": 1})


@each("encoders", [True, False])
def test_a_board_that_repeats_commands_but_not_the_question_has_no_encoders(encoders: bool) -> None:
    bench = LinkBench()
    bench.setup = LinkSetup.of(PLAIN, 100.0, FeedbackConfig(encoders=encoders))
    bench.up()
    for n in range(400):
        line = bench.line(WheelSpeeds(*[min(n % 100, 50) / 10] * 4))
        assert line is not None
        bench.wait(10, *([] if line == b"?\r\n" else [line]))
        if bench.link != "up":
            break
    assert bench.link == ("stale" if encoders else "up")
    assert not encoders or (bench.why.code == "set_points" and 100 < n < 300)


def test_an_ideal_motor_lags_by_one_line_in_a_long_ramp_but_not_at_its_ends() -> None:
    bench = LinkBench().up()
    before = 0.0
    for n in range(800):
        speed = min(n % 400, 250) / 20
        line = bench.line(WheelSpeeds(*[speed] * 4))
        assert line is not None
        late = 0.02 if n % 400 in (1, 2, 251, 252) else 0.0
        reply = bench.setup.codec.encode(WheelSpeeds(*[max(0.0, before - late)] * 4))
        bench.wait(10, *([] if line == b"?\r\n" else [reply]))
        assert bench.link == "up"
        before = speed
