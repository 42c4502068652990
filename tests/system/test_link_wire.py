"""An independent serial peer checks the bytes that the daemon sends."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.system.bystander import lost
from tests.system.harness import (
    PLAIN,
    STANDING,
    ZERO,
    ZERO_LINE,
    Bus,
    Daemon,
    Following,
    Peer,
    ReceivedMessage,
    Reply,
    Speeds,
    Tables,
    form,
    silence,
    twist,
    until,
    wheels,
)


@contextmanager
def running(
    tmp_path: Path, peer: Peer, config: Tables | None = None, linked: bool = True
) -> Iterator[Bus]:
    with Daemon(tmp_path, peer.path, config) as daemon, Bus(daemon.endpoint) as bus:
        if linked:
            bus.linked()
        yield bus


class Started(NamedTuple):
    """Lines that a board received at a start, a straight drive at 0.5 m/s and a turn at 1 rad/s."""

    stream: bytes
    """Every byte up to the end of the straight drive."""
    lines: list[bytes]
    straight: bytes
    """The steady line of the straight drive."""
    left: bytes
    """The steady line of the turn."""
    turned: float
    """Odometry's greatest yaw of the turn, rad."""


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Started:
    where = tmp_path_factory.mktemp("started")

    def steady(*others: bytes) -> bytes | None:
        """Return the first line outside `others` that the board received thirty times in a row."""
        for line, same in itertools.groupby(peer.session.raw_lines()):
            if line not in others and sum(1 for _ in same) >= 30:
                return line
        return None

    def drives(linear: float, angular: float, *others: bytes) -> bytes | None:
        # A machine that stands still for a second silences this sender, which must then send a zero
        # first. It may also deliver our replies in one burst, which no wheel could produce.
        state = bus.state()
        yaws.append(state["yaw"])
        if state["mode"] == "fault":
            assert lost(begun) > 0.05, state
            bus.get("srv/clear")
        waits = state["code"] == "neutral"
        sender.wish = ZERO if waits else twist(linear, angular)
        return steady(ZERO_LINE, *others)

    begun, yaws = time.monotonic(), [0.0]
    with Peer(where / "mcu") as peer, running(where, peer) as bus, bus.commanding(0.5) as sender:
        straight = until(lambda: drives(0.5, 0.0), 5.0, "steady driving")
        stream, lines = peer.session.stream, peer.session.raw_lines()
        left = until(lambda: drives(0.0, 1.0, straight), 5.0, "steady turning")
        yaws.append(bus.state()["yaw"])
        return Started(stream, lines, straight, left, max(yaws))


def test_the_first_bytes_are_an_end_of_line_and_a_zero_and_every_line_has_33_bytes(
    started: Started,
) -> None:
    first, *lines = started.lines
    assert started.stream.startswith(b"\r\n" + ZERO_LINE)
    assert first == b"\r\n"
    assert lines[0] == ZERO_LINE
    assert {len(line) for line in lines} == {33}


def test_half_a_metre_per_second_straight_is_10_rad_per_s_on_every_wheel(started: Started) -> None:
    assert started.straight == b"ap10.00,bp10.00,cp10.00,dp10.00\r\n"


def test_a_pure_left_turn_is_forward_on_a_and_d_and_backward_on_b_and_c(started: Started) -> None:
    # 1 rad/s on half of 0.30 m is 0.15 m/s, over 0.05 m 3 rad/s.
    assert started.left == b"ap03.00,bn03.00,cn03.00,dp03.00\r\n"
    assert started.turned > 0.1


def test_speeds_on_the_wire_grow_by_the_acceleration_limit_only(started: Started) -> None:
    # 1 m/s2 is 20 rad/s2; a step is at most 0.05 s however late the tick came.
    sped = [wheels(line)[0] for line in started.lines[1:]]
    assert max(after - before for before, after in itertools.pairwise(sped)) <= 20 * 0.05 + 0.01


@pytest.mark.slow
def test_a_trailing_comma_and_wired_signs_and_letters_apply_on_the_wire(
    tmp_path: Path, peer: Peer
) -> None:
    config: Tables = {
        "mcu": {"port": str(peer.path), "trailing_comma": True},
        "mcu.wheels": {
            "front_right": "-b", "front_left": "+a", "rear_left": "+c", "rear_right": "+d",
        },
    }  # fmt: skip
    with running(tmp_path, peer, config) as bus, bus.commanding(0.5):
        steady = b"ap10.00,bn10.00,cp10.00,dp10.00,\r\n"
        until(lambda: peer.lines[-1].line == steady, 5.0, f"{steady!r} on the wire")
        until(lambda: bus.state()["linear"] == pytest.approx(0.5), 5.0, "0.5 m/s measured")
    first, *lines = peer.session.raw_lines()
    assert first == b"\r\n"
    assert wheels(lines[0]) == STANDING
    assert {(line[-3:], len(line)) for line in lines} == {(b",\r\n", 34)}


def mixture() -> Reply:
    """Return a board that replies in each accepted form in turn, and then in a mix of forms."""

    def mixed(speeds: Speeds) -> bytes:
        a, b, c, d = (f"{'n' if speed < 0 else 'p'}{abs(speed):.3f}" for speed in speeds)
        return f"a{a[:-1]}, b{b},c{c[:-2]},  d{d},\n".encode()

    def reply(speeds: Speeds) -> bytes:
        return next(turns)(speeds)

    turns = itertools.cycle([*ACCEPTED.values(), mixed])
    return reply


ACCEPTED: dict[str, Reply] = {
    "plain": PLAIN,
    "spaces": form(separator=", "),
    "trailing_comma": form(comma=","),
    "spaces_and_trailing_comma": form(separator=", ", comma=","),
    "lf_only": form(end="\n"),
    "one_integer_digit": form(pad=1),
    "one_decimal": form(decimals=1),
    "three_decimals": form(decimals=3),
    "one_digit_one_decimal_spaces_comma_lf": form(", ", "\n", 1, 1, ","),
}


def steady(bus: Bus) -> Any:
    """Return the state if the robot drives at 0.4 m/s, otherwise None."""
    state = bus.state()
    right = state["link"] == "up" and state["linear"] == pytest.approx(0.4, abs=0.005)
    return state if right else None


@pytest.mark.slow
def test_every_accepted_reply_form_drives_odometry(tmp_path: Path, peer: Peer) -> None:
    # 0.4 m/s is 8 rad/s, which needs only one digit and one decimal.
    begun = time.monotonic()
    with running(tmp_path, peer) as bus, bus.commanding(0.4):
        until(lambda: peer.lines[-1].line.startswith(b"ap08.00"), 5.0, "steady driving")
        for name, reply in {**ACCEPTED, "mixture": mixture()}.items():
            peer.reply = reply
            peer.await_lines(5)  # by then the replies in the previous form have been read
            goal = bus.state()["x"] + 0.04
            until(lambda: bus.state()["x"] > goal, 5.0, f"odometry moves by {name}")  # noqa: B023
            after = until(lambda: steady(bus), 5.0, f"the speed by {name}")
        rejects = {key for key in after["counters"] if key.startswith("line_")}
        # A machine that takes the time of several ramp steps merges them into one.
        leaps = {"line_implausible"} if lost(begun) > 0.05 else set()
        assert rejects <= leaps, after["counters"]


def always(data: bytes) -> Reply:
    """Return a board that answers every line with `data`."""
    return lambda speeds: data


REFUSED: dict[str, tuple[str, Reply]] = {
    "a wheel missing": ("malformed", always(b"ap10.00,bp10.00,cp10.00\r\n")),
    "five wheels": ("malformed", always(b"ap10.00,bp10.00,cp10.00,dp10.00,ap10.00\r\n")),
    "a wheel twice": ("duplicate_wheel", always(b"ap10.00,bp10.00,cp10.00,cp10.00\r\n")),
    "no sign": ("malformed", always(b"a10.00,b10.00,c10.00,d10.00\r\n")),
    "a minus": ("malformed", always(b"a-10.00,b-10.00,c-10.00,d-10.00\r\n")),
    "another wheel": ("malformed", always(b"ap10.00,bp10.00,cp10.00,ep10.00\r\n")),
    "upper case": ("malformed", always(b"AP10.00,BP10.00,CP10.00,DP10.00\r\n")),
    "no decimals": ("malformed", always(b"ap10,bp10,cp10,dp10\r\n")),
    "a bare point": ("malformed", always(b"ap10.,bp10.,cp10.,dp10.\r\n")),
    "four decimals": ("malformed", always(b"ap10.0000,bp10.00,cp10.00,dp10.00\r\n")),
    "three digits": ("malformed", always(b"ap100.00,bp10.00,cp10.00,dp10.00\r\n")),
    "over 99.99": ("over_range", always(b"ap99.995,bp10.00,cp10.00,dp10.00\r\n")),
    "nan": ("malformed", always(b"apnan,bp10.00,cp10.00,dp10.00\r\n")),
    "inf": ("malformed", always(b"apinf,bp10.00,cp10.00,dp10.00\r\n")),
    "an exponent": ("malformed", always(b"ap1e1,bp10.00,cp10.00,dp10.00\r\n")),
    "a space inside": ("malformed", always(b"ap 10.00,bp10.00,cp10.00,dp10.00\r\n")),
    "a space before the comma": ("malformed", always(b"ap10.00 ,bp10.00,cp10.00,dp10.00\r\n")),
    "a space in front": ("malformed", always(b" ap10.00,bp10.00,cp10.00,dp10.00\r\n")),
    "two commas": ("malformed", always(b"ap10.00,,bp10.00,cp10.00,dp10.00\r\n")),
    "semicolons": ("malformed", always(b"ap10.00;bp10.00;cp10.00;dp10.00\r\n")),
    "noise in front": ("malformed", always(b"\x00\xff~ap10.00,bp10.00,cp10.00,dp10.00\r\n")),
    "half a line": ("malformed", always(b"ap10.00,bp10.0\r\n")),
    "two lines in one": ("malformed", always(b"ap10.00,bp10.00,cap10.00,bp10.00,cp10.00\r\n")),
    "words": ("malformed", always(b"Hello from the bootloader\r\n")),
    "an endless line": ("too_long", always(b"ap10.00,bp10.00,cp10.00,dp10.00," * 8 + b"\r\n")),
    "CR only": ("too_long", always(b"ap10.00,bp10.00,cp10.00,dp10.00\r")),
}


@pytest.mark.slow
def test_every_refused_form_is_counted_and_only_zeros_are_sent_until_a_good_one_comes(
    tmp_path: Path, peer: Peer
) -> None:
    peer.reply = silence
    with running(tmp_path, peer, linked=False) as bus:
        bus.put("cmd/app", ZERO)
        with bus.follow("state") as states:
            states.find(lambda state: state["link"] == "booting", 5.0, "booting")
        # The peer sends unasked, because a silent peer gets only 10 lines a second to answer.
        for reason, reply in REFUSED.values():
            # A line may need more than one piece to be too long.
            peer.send(reply(STANDING) * (5 if reason == "too_long" else 1))
            bus.put("cmd/app", twist(0.5))
        wanted = Counter(reason for reason, _ in REFUSED.values() if reason != "too_long")

        def counted() -> Any:
            state = bus.state()
            count = state["counters"].get
            complete = all(count(f"line_{reason}") == many for reason, many in wanted.items())
            return state if complete and count("line_too_long", 0) >= 2 else None

        # The daemon ignores these bytes, even with a commander that keeps sending.
        state = until(counted, 5.0, "each line is counted by its reason")
        assert (state["link"], state["x"], state["linear"]) == ("booting", 0.0, None)
        assert state["counters"]["lines"] == 0
        assert set(peer.session.raw_lines()[1:]) == {ZERO_LINE}
        # The next newline resynchronises: after three good lines the link is up.
        peer.send(b"\r\n")
        peer.reply = PLAIN
        bus.linked()


@pytest.mark.slow
def test_a_silent_board_is_reported_gets_only_zeros_and_drives_on_after_a_short_gap(
    tmp_path: Path, peer: Peer
) -> None:
    with running(tmp_path, peer) as bus, bus.follow("state") as states, bus.commanding(0.5):
        until(lambda: peer.lines[-1].line.startswith(b"ap10.00"), 5.0, "steady driving")
        silent, stale, _ = _fall_silent(peer, states)
        print(f"peer falls silent -> stale in state: {stale.at - silent:.3f} s")
        assert stale.at - silent < 0.1 + 0.5 + lost(silent, stale.at)
        assert stale.value["code"] == "link_silent"
        pose = bus.state()["x"]
        zeros = peer.await_lines(2)
        assert {entry.line for entry in zeros} == {ZERO_LINE}
        assert bus.state()["x"] == pose
        # After a silence under a second the commander is still armed, and the ramp starts from
        # zero.
        peer.reply = PLAIN
        again = until(lambda: _moving_since(peer, zeros[-1].at), 5.0, "driving again")
        assert wheels(again)[0] <= 20 * 0.05 + 0.01


@pytest.mark.slow
def test_after_a_silence_of_a_second_the_commander_must_be_neutral_first(
    tmp_path: Path, peer: Peer
) -> None:
    with running(tmp_path, peer) as bus, bus.follow("state") as states:  # noqa: SIM117
        with bus.commanding(0.5) as commander:
            until(lambda: peer.lines[-1].line.startswith(b"ap10.00"), 5.0, "steady driving")
            _, stale, zeros_from = _fall_silent(peer, states)
            zeros = peer.await_lines(14)
            # The daemon sends at 10 Hz while no replies come, whatever the commander wants.
            assert {entry.line for entry in zeros} == {ZERO_LINE}
            took = zeros[-1].at - zeros[0].at
            assert 0.08 < took / 13 < 0.2 + lost(zeros[0].at, zeros[-1].at) / 13
            peer.reply = PLAIN
            back = states.find(lambda state: state["link"] == "up", 5.0, "up", after=stale.at).at
            waiting = states.find(
                lambda state: state["code"] == "neutral",
                5.0,
                "why it waits",
                after=back,
            )
            assert waiting.value["mode"] == "ready"
            peer.await_lines(50)
            assert _moving_since(peer, zeros_from) is None
            commander.wish = ZERO  # for a second, because the key alone identifies this sender
            until(lambda: bus.state()["code"] != "neutral", 5.0, "neutral")
            commander.wish = twist(0.5)
            until(lambda: _moving_since(peer, zeros_from), 5.0, "driving after the zero")


def _fall_silent(peer: Peer, states: Following) -> tuple[float, ReceivedMessage, float]:
    """Mute the board and wait until the daemon sends zeros.

    Returns the time of the muting, the state that reports the stale link, and the time of the last
    line that was not zero.
    """
    peer.reply = silence
    muted = time.monotonic()
    stale = states.find(lambda state: state["link"] == "stale", 5.0, "stale", after=muted)
    until(lambda: peer.lines[-1].line == ZERO_LINE, 2.0, "zeros")
    last = max(entry.at for entry in peer.lines if entry.line != ZERO_LINE)
    return muted, stale, last


def _moving_since(peer: Peer, after: float) -> bytes | None:
    """Return the first line after this time that is not zero."""
    moving = (entry.line for entry in peer.lines if entry.at > after and entry.line != ZERO_LINE)
    return next(moving, None)


@pytest.mark.slow
def test_noise_between_good_replies_costs_only_itself(tmp_path: Path, peer: Peer) -> None:
    noise = itertools.cycle([b"\x00\xff\xfe\r\n", b"ap10.0\n", b"", b"\r\n\r\n"])
    peer.reply = lambda speeds: next(noise) + PLAIN(speeds)
    with running(tmp_path, peer) as bus, bus.commanding(0.5):
        until(lambda: bus.state()["x"] > 0.3, 5.0, "it drives")
        state = bus.comes_to("driving")
    assert state["counters"]["line_malformed"] > 10
