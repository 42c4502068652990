"""Tests of the link's states, and of the time, the gap and the session number of good lines."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import replace

from acsard.core.codes import Reason
from acsard.core.config.settings import FeedbackConfig, McuConfig, WheelMap
from acsard.core.config.wire_time import wire_ns
from acsard.core.link.checked_line import seal
from acsard.core.link.feedback import MIN_INTERVAL_NS, Feedback
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import BAD_LINES, GOOD_LINES
from acsard.core.link.session import LONG_GAP_NS, QUESTION_LINE, McuSession
from acsard.core.values import NS_PER_S, STILL, Instant, Received, WheelSpeeds
from tests.each import each
from tests.vectors.lines import SEED_LINE, SEED_MOTORS, ZERO

MS = 1_000_000
GOOD = SEED_LINE + b"\r\n"
BAD = b"hello\r\n"
WALL_NS = 1_800_000_000 * NS_PER_S
CHECKED = McuConfig(link_check="on")
FREE = McuConfig(reply_period=0.01)
SLOW = WheelSpeeds(1.0, 1.0, 1.0, 1.0)


class Bench:
    """A session with a simulated time, and a port that can be opened and closed."""

    def __init__(
        self, mcu: McuConfig | None = None, rate_hz: float = 100.0, longest_reply: float = 0.25
    ) -> None:
        self.setup = LinkSetup.of(mcu or McuConfig(), rate_hz, longest_reply=longest_reply)
        self.session = McuSession()
        self.now_ns = self.made_ns = 1000 * MS
        self.opened = 0
        self.port_open = False

    @property
    def now(self) -> Instant:
        return Instant(self.now_ns, self.now_ns + WALL_NS)

    def link(self) -> str:
        return self.session.link

    def why(self) -> Reason:
        return self.session.describe_link(self.setup)

    def counts(self) -> tuple[int, ...]:
        return self.session.count_recovery.counts(self.setup.mcu.encoder_counts)

    def line(self, speeds: WheelSpeeds = SLOW) -> bytes | None:
        self.made_ns = self.now_ns
        return self.session.line(self.setup, self.now_ns, speeds)

    def answer(self, line: bytes | None) -> bytes:
        """Return the checked reply to a line from the host."""
        assert line is not None
        return seal(GOOD, int(line.partition(b"#")[2][:2], 16))

    def talk(self, ms: int = 10, count: int = 1) -> list[Feedback]:
        """Send a line and receive its answer `ms` later, `count` times."""
        samples = []
        for _ in range(count):
            line = self.line()
            if line is None or line == QUESTION_LINE:
                samples += self.wait(ms)
            else:
                samples += self.wait(ms, self.answer(line) if b"#" in line else ZERO + b"\r\n")
        return samples

    def checked(self) -> Bench:
        """Open the port and talk until the link is up and checked."""
        self.open().wait(10)
        self.talk(count=3)
        assert (self.link(), self.session.check(self.setup)) == ("up", "checked")
        return self

    def names(self) -> list[str]:
        """Return the names of the last update's events."""
        return [event.name for event in self.session.events]

    def open(self) -> Bench:
        self.opened += 1
        self.port_open = True
        return self

    def close(self) -> Bench:
        self.port_open = False
        return self

    def wait(self, ms: float, *reads: bytes) -> list[Feedback]:
        """Let `ms` pass, then update the session with the bytes that were read just now.

        Before that, the stop and the question with which a session begins leave the port.
        """
        session = self.session
        if session._made is None and self.port_open and (session._first or session._echo.due):
            self.line()
        if session._made is not None and session._made[0] == QUESTION_LINE:
            reads = BOOTED, *reads
        self.now_ns += int(ms * MS)
        received = tuple(Received(self.now, data) for data in reads)
        self.session.sent(self.setup, self.made_ns, was_written=True)
        return self.session.update(self.setup, self.now, self.port_open, self.opened, received)

    def happen(self, port: str, ms: float, data: bytes) -> None:
        """Open or close the port if `port` says so, let time pass, and read these bytes."""
        if port:
            self.open() if port == "open" else self.close()
        self.wait(ms, *([data] if data else []))

    def up(self) -> Bench:
        """Open the port and feed good lines until the link is up."""
        self.open().wait(10)
        for _ in range(1 + GOOD_LINES):
            self.wait(10, GOOD)
        return self


# the link


NOISE = b"\x00\xf8~boot\r\n" + GOOD[:20]
LONG = b"x" * 200 + b"\r\n" + GOOD
BOOTED = b"!acsard-mcu 1 counts=3200 watchdog_ms=300 check=1 sample=1\r\n"

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
    "a stale link, and a port that closes": [
        *UP, *QUIET, ("close", 10, b"", "down"),
    ],
    "a board that restarts within one read": [
        *UP, ("", 10, BOOTED + GOOD * 4, "booting"), *[("", 10, GOOD, "booting")] * 2,
        ("", 10, GOOD, "up"),
    ],
}  # fmt: skip


def test_a_line_is_never_older_than_the_previous_line() -> None:
    bench = Bench(replace(FREE, baud_rate=9600)).open()
    (first,) = bench.wait(10, GOOD)
    (second,) = bench.wait(1, GOOD + GOOD[:20])  # 20.8 ms of wire time within 1 ms
    # The stamps must also differ. A reader of the transforms takes the second of two with one stamp
    # for an echo.
    assert second.at.mono_ns == first.at.mono_ns + MIN_INTERVAL_NS
    assert second.at.wall_ns == first.at.wall_ns + MIN_INTERVAL_NS
    assert second.dt == 0.0


def test_a_step_of_the_wall_clock_changes_no_dt() -> None:
    setup, session = LinkSetup.of(FREE, 100.0), McuSession()
    for step in range(1, 10):
        now = Instant(step * 10 * MS, WALL_NS + (-1) ** step * 3600 * NS_PER_S)
        (feedback,) = session.update(setup, now, True, 1, (Received(now, GOOD),))
        assert feedback.dt == (0.01 if step > 1 else 0.0)
        late_ns = now.mono_ns - feedback.at.mono_ns
        assert late_ns == now.wall_ns - feedback.at.wall_ns == wire_ns(len(GOOD), 115200)


# gaps


def test_after_a_gap_dt_is_zero_and_the_length_of_the_gap_is_reported() -> None:
    bench = Bench(FREE).up()
    bench.wait(1200)
    (feedback,) = bench.wait(50, GOOD)
    assert (feedback.dt, feedback.gap) == (0.0, 1.25)


def test_a_silence_up_to_the_silence_limit_is_not_a_gap() -> None:
    bench = Bench(FREE).up()
    (feedback,) = bench.wait(100, GOOD)
    assert (feedback.dt, feedback.gap) == (0.1, 0.0)


def test_bad_lines_occupy_their_periods() -> None:
    bench = Bench(FREE).up()
    for _ in range(15):
        bench.wait(10, BAD)
    (feedback,) = bench.wait(10, GOOD)
    assert (feedback.dt, feedback.bridged, feedback.gap) == (0.16, 0.15, 0.0)


def test_the_second_line_after_a_gap_has_a_dt_again() -> None:
    bench = Bench(FREE).up()
    bench.wait(500, GOOD)
    (feedback,) = bench.wait(10, GOOD)
    assert (feedback.dt, feedback.gap) == (0.01, 0.0)


def test_the_time_with_a_closed_port_is_always_a_gap() -> None:
    bench = Bench(FREE).up()
    bench.close().wait(20)
    (feedback,) = bench.open().wait(20, GOOD)
    assert (feedback.dt, feedback.gap) == (0.0, 0.04)


# a new session


QUIET_MS = LONG_GAP_NS / MS

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
}  # fmt: skip
"""What happens to the port, the ms that pass, the bytes read then, and whether it restarts."""


@each("case", RESTARTS)
def test_a_session_restarts_with_the_port_and_after_a_long_gap(case: str) -> None:
    bench = Bench()
    for port, ms, data, restarted in RESTARTS[case]:
        bench.happen(port, ms, data)
        assert bench.session.restarted is restarted


@pytest.mark.parametrize("begins", ["board", "port"])
def test_a_new_session_with_a_late_first_line_restarts_again_at_that_line(begins: str) -> None:
    """The restart is reported again at the first line, because the board may have been silent.

    A zero that was sent while the board was silent must not arm its sender.
    """
    bench = Bench().up()
    if begins == "port":
        bench.open().wait(10)
    else:
        bench.wait(10, BOOTED)
    assert bench.session.restarted
    bench.wait(LONG_GAP_NS / MS)
    assert not bench.session.restarted
    bench.wait(0, GOOD)
    assert bench.session.restarted


# counting


def test_good_lines_are_counted_and_bad_ones_by_reason() -> None:
    bench = Bench().up()
    bench.wait(10, b"hello\r\n" + GOOD + b"x" * 200 + b"\n" + b"x\r\n")
    bench.wait(10, b"ap99.999,bp00.00,cp00.00,dp00.00\n" + b"\x00" * 300)
    bench.wait(10, b"\n" + b"ap01.00,ap00.00,cp00.00,dp00.00\n" * 3)
    assert bench.session.good_lines == GOOD_LINES + 2
    assert bench.session.rejects == {
        "malformed": 2,
        "too_long": 2,
        "over_range": 1,
        "duplicate_wheel": 3,
    }


def test_the_line_counters_continue_in_the_next_session() -> None:
    bench = Bench().up()
    bench.wait(10, BAD + b"x" * 200)
    bench.close().wait(10)
    bench.open().wait(10, BAD + b"x" * 200 + b"\n" + GOOD)
    assert bench.session.rejects["malformed"] == 2
    assert bench.session.rejects["too_long"] == 2
    assert bench.session.good_lines == GOOD_LINES + 2


def test_the_line_is_read_by_the_wheel_map_of_the_configuration() -> None:
    mcu = McuConfig(wheels=WheelMap("-d", "+b", "+c", "-a"))
    (feedback,) = Bench(mcu).open().wait(10, GOOD)
    assert feedback.speeds == WheelSpeeds(10.25, -8.75, 15.0, -12.5)


def test_the_codec_writes_the_dialect_of_the_configuration() -> None:
    setup = LinkSetup.of(McuConfig(trailing_comma=True), 100.0)
    assert setup.codec.encode(WheelSpeeds(*SEED_MOTORS)) == SEED_LINE + b",\r\n"


# the checked link


@each("mcu", [McuConfig(), CHECKED])
def test_a_session_begins_with_a_plain_stop_and_the_question_follows_the_first_line(
    mcu: McuConfig,
) -> None:
    bench = Bench(mcu).open()
    bench.wait(10)
    lines = [bench.line()]
    for _ in range(50):
        bench.wait(10)
        lines.append(bench.line())
    assert set(lines) <= {None, ZERO + b"\r\n", *[seal(ZERO, n) for n in range(9)]}
    assert lines[0] == ZERO + b"\r\n"
    bench.wait(10, ZERO + b"\r\n")
    assert bench.line() == b"?\r\n"
    update(bench, left=False, read=b"")
    assert bench.line() == b"?\r\n"  # until it has left
    update(bench, left=True, read=b"")
    assert bench.line() != b"?\r\n"


def test_the_first_right_reply_opens_a_checked_link() -> None:
    bench = Bench(CHECKED).open()
    bench.wait(10)
    bench.talk(count=2)
    assert (bench.link(), bench.session.good_lines) == ("booting", 0)
    bench.talk()
    assert (bench.link(), bench.session.good_lines) == ("up", 1)


def test_plain_replies_never_open_a_checked_link_and_the_reason_says_what_to_change() -> None:
    bench, events = Bench(CHECKED).open(), []
    for _ in range(300):
        bench.wait(10, GOOD)
        line = bench.line()
        assert line is None or line.startswith((ZERO, b"?"))
        assert bench.link() == "booting"
        events += bench.session.events
    assert bench.session.good_lines == 0
    (outcome,) = [event for event in events if event.name == "link_check"]
    assert (outcome.level, outcome.code) == ("error", "no_checksum")
    why = bench.why()
    assert why.code == "no_checksum"
    assert 'mcu.link_check = "off"' in why.text
    bench.wait(100)
    bench.wait(10, bench.answer(bench.line()))  # other firmware was flashed
    assert bench.link() == "up"


def test_a_board_that_ignores_checked_lines_is_known_by_its_reply_to_the_first_stop() -> None:
    bench = Bench(CHECKED).open()
    bench.wait(10)
    bench.wait(10, GOOD)
    for _ in range(320):
        bench.line()
        bench.wait(10)
    assert bench.why().code == "no_checksum"


def test_a_silent_board_on_a_checked_link_is_told_by_a_reason_with_the_setting() -> None:
    for mcu, told in ((CHECKED, True), (McuConfig(), False)):
        bench = Bench(mcu).open()
        for _ in range(320):
            bench.line()
            bench.wait(10)
        why = bench.why()
        assert why.code == "received_nothing"
        assert ("mcu.link_check" in why.text) is told


@each("counts", [0, 3200])
def test_a_board_without_counts_is_reported_only_if_counts_are_configured(counts: int) -> None:
    bench, names = Bench(McuConfig(link_check="on", encoder_counts=counts)).open(), []
    bench.wait(10)
    for _ in range(20):
        bench.talk()
        names += bench.names()
    assert names.count("link_check") == bool(counts)


@each(
    ("line", "reason"),
    [
        (GOOD, "without_crc"),
        (seal(GOOD, 200), "stale_sequence"),
        (seal(GOOD, 1).replace(b"12.50", b"12.51"), "crc_error"),
        (seal(b"ap12.50\r\n", 1), "malformed"),
        (b"x" * 200 + b"\n", "too_long"),
    ],
)
def test_on_a_checked_link_a_reply_without_a_right_suffix_is_dropped_and_counted(
    line: bytes, reason: str
) -> None:
    bench = Bench(CHECKED).checked()
    bench.session.rejects.clear()
    assert bench.wait(1, line) == []
    assert bench.session.rejects == {reason: 1}
    assert bench.link() == "up"


def test_replies_that_arrive_twice_count_once_and_are_no_damage() -> None:
    bench, samples = Bench(CHECKED).checked(), []
    for n in range(20):
        reply = bench.answer(bench.line())
        samples += bench.wait(10, *([reply * 2] if n % 2 else [reply, reply * 9]))
        assert bench.names() == []
    assert len(samples) == 20
    assert [sample.bridged for sample in samples] == [0.0] * 20
    assert bench.session.rejects == {"repeated": 10 + 90}
    assert bench.link() == "up"


def test_each_reply_to_pipelined_lines_is_accepted() -> None:
    bench = Bench(CHECKED).checked()
    replies = []
    for _ in range(4):
        replies.append(bench.answer(bench.line()))
        bench.wait(10)
    assert len(bench.wait(1, b"".join(replies))) == 4


def test_five_bad_replies_in_a_row_end_the_link_until_the_next_right_one() -> None:
    bench = Bench(CHECKED).checked()
    bench.wait(1, BAD * (BAD_LINES - 1))
    assert bench.link() == "up"
    bench.wait(1, BAD)
    assert bench.link() == "stale"
    assert bench.why().code == "replies_damaged"
    bench.talk()
    assert bench.link() == "up"


def test_bad_replies_among_right_ones_are_only_counted() -> None:
    bench = Bench(CHECKED).checked()
    for _ in range(50):
        bench.wait(10, BAD * (BAD_LINES - 1) + bench.answer(bench.line()))
    assert bench.link() == "up"


def test_without_a_right_reply_plain_ones_do_not_hold_the_link() -> None:
    bench = Bench(CHECKED).checked()
    for _ in range(3):
        bench.wait(30, GOOD)
    assert bench.link() == "up"
    bench.wait(11, GOOD)
    assert bench.link() == "stale"
    for _ in range(500):
        bench.wait(10, GOOD)
        bench.line()
        assert bench.link() == "stale"
    assert bench.why().code == "no_checksum"


@pytest.mark.parametrize("mcu", [McuConfig(), CHECKED], ids=["plain", "checked"])
def test_an_mcu_that_names_itself_has_restarted(mcu: McuConfig) -> None:
    bench = Bench(mcu).checked() if mcu is CHECKED else Bench(mcu).up()
    bench.wait(30, BOOTED)
    assert bench.session.restarted
    assert bench.link() == "booting"
    assert bench.names() == ["mcu_restarted", "link_booting"]
    line = bench.line()
    assert line is None or line.startswith(ZERO)
    assert bench.session.rejects == {}


def test_the_identity_line_of_an_mcu_that_is_still_booting_is_not_a_restart_event() -> None:
    bench = Bench(CHECKED).open()
    bench.wait(10, BOOTED)
    assert bench.names() == ["link_booting"]
    assert bench.session.restarted


def test_the_name_of_the_board_answers_the_question_and_is_no_restart() -> None:
    bench = Bench().open()
    bench.wait(10)
    bench.wait(10, GOOD)
    bench.wait(10, GOOD)  # with the name
    assert not bench.session.restarted
    bench.wait(10, GOOD + GOOD)
    assert bench.link() == "up"
    bench.wait(30, BOOTED)
    assert bench.session.restarted


# echoes


def echoed(bench: Bench, speed: float, count: int, *, board: bytes = b"") -> list[bytes]:
    """Return each line to the host 10 ms later, behind `board`, and return the lines."""
    lines = []
    for _ in range(count):
        line = bench.line(WheelSpeeds(*[speed if bench.link() == "up" else 0.0] * 4))
        lines += [line] if line else []
        bench.wait(10, board + (line or b""))
    return lines


@each("mcu", [McuConfig(), CHECKED, McuConfig(link_check="on", encoder_counts=3200)])
@each("board", [b"", GOOD])
def test_a_port_that_returns_the_question_is_never_linked(mcu: McuConfig, board: bytes) -> None:
    bench = Bench(mcu).open()
    bench.wait(10)
    lines = echoed(bench, 1.0, 1000, board=board)
    assert (bench.link(), bench.why().code) == ("booting", "echo")
    assert all(line.startswith((ZERO, b"?")) for line in lines)
    bench.checked() if mcu.checked else bench.up()  # until the port is opened again


def test_a_returned_question_counts_only_while_an_answer_may_come() -> None:
    bench = Bench().up()
    bench.wait(1000, GOOD)
    bench.wait(10, b"?\r\n")
    assert bench.link() == "up"
    assert bench.session.rejects == {"echo": 1}


def test_lines_that_return_during_a_drive_raise_the_question_after_a_change_of_speed() -> None:
    bench = Bench().up()
    assert b"?\r\n" not in echoed(bench, 0.0, 300)  # every board at rest repeats zeros
    lines = echoed(bench, 1.0, 100)
    assert lines.count(b"?\r\n") == 1
    assert (bench.link(), bench.why().code) == ("stale", "echo")


@each("encoders", [True, False])
def test_a_board_that_repeats_commands_but_not_the_question_has_no_encoders(encoders: bool) -> None:
    bench = Bench()
    bench.setup = LinkSetup.of(McuConfig(), 100.0, FeedbackConfig(encoders=encoders))
    bench.up()
    for n in range(400):
        speed = n % 100 / 10
        line = bench.line(WheelSpeeds(speed, speed, speed, speed))
        assert line is not None
        bench.wait(10, *([] if line == b"?\r\n" else [line]))
        if bench.link() != "up":
            break
    assert bench.link() == ("stale" if encoders else "up")
    if encoders:
        assert bench.why().code == "set_points"
        assert 150 < n < 300


def test_the_question_never_takes_the_place_of_the_line_that_stops_the_wheels() -> None:
    bench = Bench().up()
    echoed(bench, 1.0, 46)
    assert bench.session._echo.due
    assert bench.line(STILL) == ZERO + b"\r\n"
    bench.wait(10, GOOD)
    assert bench.line(STILL) == b"?\r\n"


def test_measured_speeds_raise_no_question() -> None:
    bench = Bench().up()
    for n in range(1000):
        line = bench.line(WheelSpeeds(n / 100, 0.0, 0.0, 0.0))
        assert line is not None
        assert line != b"?\r\n"
        bench.wait(10, line if n % 8 else GOOD)


# silence and restarts


def test_the_first_stop_of_a_silence_is_sent_without_delay() -> None:
    """The daemon sends the stop although it sent a line with a speed one period before."""
    bench = Bench().up()
    while not bench.session.silent(bench.now_ns):
        assert bench.line() == b"ap01.00,bp01.00,cp01.00,dp01.00\r\n"
        bench.wait(10)
    assert bench.line() == bench.setup.codec.stop


def test_an_mcu_that_restarted_gets_a_stop_without_delay() -> None:
    bench = Bench().up()
    assert bench.line() == b"ap01.00,bp01.00,cp01.00,dp01.00\r\n"
    bench.wait(10, BOOTED)
    assert bench.line() == bench.setup.codec.stop


def test_a_board_that_reports_by_its_own_clock_gets_no_more_time_behind_a_late_step() -> None:
    """The lines of a free-running board wait in the kernel until the late step reads them.

    A late step that finds no line therefore proves that the board is silent.
    """
    bench = Bench(McuConfig(reply_period=0.02)).up()
    bench.wait(150)
    assert bench.link() == "stale"


def test_a_silent_mcu_gets_stops_at_ten_hertz() -> None:
    bench = Bench().up()
    for _ in range(3):
        bench.wait(50)
    assert bench.line(WheelSpeeds(5.0, 5.0, 5.0, 5.0)) == bench.setup.codec.stop
    lines = []
    for _ in range(100):
        bench.wait(10)
        lines.append(bench.line())
    assert [line for line in lines if line] == [bench.setup.codec.stop] * 10


def test_zero_speeds_are_sent_as_the_stop_line() -> None:
    assert Bench().up().line(STILL) == ZERO + b"\r\n"


def disbelieved() -> Bench:
    """Return a bench whose configured counts disagree with the speeds that the board reports."""
    bench, dice = Bench(replace(FREE, encoder_counts=20)).up(), random.Random(1)
    for _ in range(100):
        line = ",".join(f"{motor}p{dice.uniform(20, 60):05.2f}" for motor in "abcd")
        bench.wait(10, line.encode() + b"\r\n")
    assert bench.counts() == (0,) * 4
    return bench


def test_the_configured_counts_are_trusted_again_after_the_port_reopens() -> None:
    bench = disbelieved()
    bench.close().wait(10)
    bench.open().wait(10)
    assert bench.counts() == (20,) * 4


def test_the_configured_counts_are_trusted_again_after_the_mcu_restarts() -> None:
    bench = disbelieved()
    bench.wait(10, BOOTED)
    assert bench.counts() == (20,) * 4


@pytest.mark.parametrize("reads", [1, 4])
def test_the_bad_lines_of_an_update_make_one_event_for_each_reason(reads: int) -> None:
    bench = Bench().open()
    bench.wait(10)
    bench.wait(10, *([b"x\r\n" * 200 + b"ap99.99\r\n" + b"y" * 300 + b"\r\n"] * reads))
    rows = [(event.kind, event.count, event.text) for event in bench.session.events]
    assert rows == [("malformed", 201 * reads, "b'ap99.99'"), ("too_long", reads, "")]
    assert bench.session.rejects == {"malformed": 201 * reads, "too_long": reads}


# the command to rest


def driven_ms(bench: Bench, *lines: tuple[WheelSpeeds, float]) -> float:
    """Write these lines, let the given time in ms pass after each, and then receive a good line.

    Returns the time from the last sample before these lines to the command to rest, ms.
    """
    for speeds, ms in lines:
        bench.line(speeds)
        bench.wait(ms)
    (feedback,) = bench.wait(0, GOOD)
    return 1000 * feedback.driven


WIRE_MS = wire_ns(len(GOOD), 115200) / MS


@pytest.mark.parametrize(
    "mcu",
    [
        FREE,
        replace(FREE, trailing_comma=True),
        replace(FREE, wheels=WheelMap("-d", "+c", "-b", "+a")),
    ],
)
def test_a_line_tells_when_rest_was_commanded_after_the_last_motion(mcu: McuConfig) -> None:
    moves, rests = (SLOW, 10.0), (STILL, 10.0)
    bench = Bench(mcu).up()
    assert driven_ms(bench, moves, moves, rests, rests) == pytest.approx(20 + WIRE_MS)
    assert driven_ms(bench, rests, rests) == pytest.approx(-20 + WIRE_MS), "before that line"
    assert driven_ms(bench, moves, rests, moves, rests) == pytest.approx(30 + WIRE_MS)


def test_behind_a_stall_the_watchdog_has_stopped_the_motors_before_the_zeros() -> None:
    bench = Bench(FREE, rate_hz=20.0).up()
    assert driven_ms(bench, (SLOW, 10), (SLOW, 190), (STILL, 10)) == pytest.approx(200 + WIRE_MS)
    late = driven_ms(bench, (SLOW, 10), (SLOW, 500), (STILL, 10), (STILL, 10))
    assert late == pytest.approx(310 + WIRE_MS)


def test_zeros_that_did_not_leave_command_no_rest() -> None:
    bench = Bench(FREE).up()
    bench.line(SLOW)
    bench.wait(10)
    for left in (False, True):
        bench.line(STILL)
        update(bench, left=left, read=b"")
    (feedback,) = bench.wait(0, GOOD)
    assert 1000 * feedback.driven == pytest.approx(20 + WIRE_MS)


def test_a_checked_line_of_zeros_commands_rest() -> None:
    bench = Bench(McuConfig(link_check="on")).checked()
    line = bench.line(SLOW)
    assert line is not None
    bench.wait(10)
    zeros = bench.line(STILL)
    (feedback,) = bench.wait(10, bench.answer(zeros))
    assert 1000 * feedback.driven == pytest.approx(
        10 + wire_ns(len(bench.answer(zeros)), 115200) / MS
    )


# a blocked output


def update(bench: Bench, *, left: bool, ms: float = 10, read: bytes = GOOD) -> None:
    """Let time pass, then update the session. `left` says whether the port sent the last line."""
    bench.now_ns += int(ms * MS)
    received = (Received(bench.now, read),) if read else ()
    bench.session.sent(bench.setup, bench.made_ns, was_written=left)
    bench.session.update(bench.setup, bench.now, bench.port_open, bench.opened, received)


def blocked(bench: Bench, ms: float) -> Bench:
    """Return a session whose port sent no line for this time, although good lines arrived."""
    bench.line()
    update(bench, left=True)
    for _ in range(round(ms / 10)):
        bench.line()
        update(bench, left=False)
    return bench


def test_an_output_that_is_blocked_for_the_watchdog_time_makes_the_link_stale() -> None:
    bench = blocked(Bench().up(), 290)
    assert (bench.link(), bench.session.blocked) == ("up", False)
    bench.line()
    update(bench, left=False, ms=20)
    assert (bench.link(), bench.session.blocked) == ("stale", True)
    assert bench.names() == ["link_stale"]
    codes = bench.why().code, bench.session.events[0].code
    assert codes == ("port_blocked", "port_blocked")


@pytest.mark.parametrize(("ms", "restarted"), [(900, False), (1010, True)])
def test_a_sent_line_ends_the_block_and_a_block_of_a_second_restarts_the_session(
    ms: float, restarted: bool
) -> None:
    bench = blocked(Bench().up(), ms)
    bench.line()
    update(bench, left=True)
    assert (bench.session.blocked, bench.session.restarted) == (False, restarted)
    for _ in range(GOOD_LINES):
        bench.line()
        update(bench, left=True)
    assert bench.link() == "up"


def test_a_late_step_is_not_a_blocked_output() -> None:
    bench = Bench().up()
    bench.line()
    update(bench, left=False, ms=400)
    bench.line()
    update(bench, left=True)
    assert not bench.session.blocked


def test_closing_the_port_ends_the_block_of_the_output() -> None:
    bench = blocked(Bench().up(), 500)
    bench.close().wait(10)
    assert not bench.session.blocked
    bench.up()
    assert bench.link() == "up"


def test_stops_are_made_at_ten_hertz_for_a_closed_port_and_directly_when_it_opens() -> None:
    bench = Bench()
    made = []
    for _ in range(100):
        update(bench, left=False, read=b"")
        made.append(bench.line())
    assert len([line for line in made if line]) == 10
    bench.open()
    update(bench, left=False, read=b"")
    assert bench.line() == ZERO + b"\r\n"


def test_a_blind_stop_that_was_not_sent_is_made_again_with_the_next_line() -> None:
    bench = Bench().open()
    bench.wait(10)
    assert bench.line() == ZERO + b"\r\n"
    update(bench, left=False, read=b"")
    assert bench.line() == ZERO + b"\r\n"
    update(bench, left=True, read=b"")
    assert bench.line() is None
