"""Faults of processes, the kernel and the serial line (SAFETY section 2), with the real daemon.

The faults of the bus are in `test_bus_faults.py`. Every promise has a short test here. The long
tests run with `pytest -m soak -s tests/system/test_link_faults.py`, which prints their results.
"""

from __future__ import annotations

import itertools
import os
import pty
import random
import signal
import statistics
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.system.bystander import lost
from tests.system.harness import (
    PLAIN,
    ZERO,
    ZERO_LINE,
    Bus,
    Daemon,
    FarPeer,
    Following,
    Peer,
    Periods,
    Program,
    ReceivedLine,
    broken,
    kept_waiting,
    seconds,
    twist,
    until,
)
from tests.system.strangers import BUSY, COMMANDER, command_line

TIMEOUT_S = 0.25
TICK_S = 0.01
WIRE_S = 33 * 10 / 115200
"""A line's time on the wire at the default baud rate, 2.86 ms."""

SLACK_S = 0.1
"""The time that a noisy two-core machine may add to a bound before a test calls it broken."""

GIVEN_UP_S = 0.3
"""The daemon gives up a link over which no line has left for this time."""

ZERO_TEXT = ZERO_LINE.strip()


def commander(daemon: Daemon, speed: float, source: str = "app", zeros: int = 1) -> Program:
    """Run a process that sends stamped commands at 20 Hz until it is ended."""
    return Program(
        command_line(COMMANDER, daemon.endpoint, source, speed, zeros), daemon.config.parent
    )


def drives(peer: FarPeer, driver: Program, speed: float = 0.3) -> ReceivedLine:
    """Wait for the first line with this speed in m/s, and return it.

    If a busy machine has delayed the commander's first zero, the commander must send zeros again.
    """
    begun = said = time.monotonic()

    def look() -> ReceivedLine | None:
        nonlocal said
        if time.monotonic() > said + 4.0 and len(driver.out) > 3:
            said = time.monotonic()
            driver.signal(signal.SIGUSR1)
        return next((h for h in peer.since(begun) if h.line.startswith(text(speed))), None)

    return until(look, 10.0, f"{speed} m/s on the wire")


@contextmanager
def robot(where: Path) -> Iterator[tuple[FarPeer, Daemon]]:
    """A daemon and its MCU."""
    with FarPeer(where) as peer, Daemon(where, peer.path) as daemon:
        yield peer, daemon


@pytest.fixture(scope="module")
def one_robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FarPeer, Daemon]]:
    """A daemon and its MCU for short faults, after which the robot can always drive again."""
    with robot(tmp_path_factory.mktemp("far")) as both:
        yield both


@pytest.fixture
def far(one_robot: tuple[FarPeer, Daemon]) -> Iterator[tuple[FarPeer, Daemon]]:
    """Provide `one_robot` at rest, so that the lines of two commanders do not mix.

    After the test, print the daemon's log of this test. pytest shows it if the test failed.
    """
    peer, daemon = one_robot
    began = len(daemon.err)
    until(lambda: [h.line for h in peer.lines[-1:]] == [ZERO_TEXT], 5.0, f"at rest\n{daemon}")
    yield one_robot
    print("\n".join(daemon.err[began:]))


def last_put(program: Program) -> float:
    """Return when a commander that has ended sent its last command."""
    # A commander killed in the middle of a line has printed "put" and not yet the time.
    rows = [line.split() for line in program.out[-2:]]
    return max(float(words[1]) for words in rows if len(words) == 2)


def puts_of(program: Program) -> list[float]:
    """Return the times of a commander's commands.

    The last time is left out, because the killed commander may have printed only a part of it.
    """
    return [float(line.split()[1]) for line in program.out[:-1]]


def text(speed: float) -> bytes:
    """Return the beginning of a line that drives straight at this speed, m/s."""
    return f"ap{speed / 0.05:05.2f},".encode()


def gaps(lines: list[ReceivedLine]) -> list[float]:
    return [after.at - before.at for before, after in itertools.pairwise(lines)]


# a commander dies


class Ramp(NamedTuple):
    """The time from the last accepted command to the ramp, s.

    The time lost to other programs is subtracted.
    """

    step: float
    """Until the first slower step, by the daemon's own stamps."""
    line: float
    """Until its line at the far end of the pty, by the clock of this machine."""


LATE_S = 0.005
"""The delay that a late timer tick may add on a busy machine. The test prints how many needed it.
"""


def killed_commanders(peer: FarPeer, daemon: Daemon, count: int) -> list[Ramp]:
    """Kill a commander `count` times. Return the times from its last command to the ramp.

    The last command counts from its acceptance, which follows from `state`: the stamp minus the
    source's age. So a command that was lost with the commander does not matter, and the travel time
    of commands does not count.
    """
    rng, ramps = random.Random(1), []
    with (
        Bus(daemon.endpoint) as bus,
        bus.follow("state") as states,
        bus.follow("cmd_vel_out") as steps,
    ):
        wall = time.time() - time.monotonic()
        for _ in range(count):
            with commander(daemon, 0.1) as driver:
                steady = drives(peer, driver, 0.1).at
                time.sleep(rng.uniform(0.0, 0.1))  # killed at any moment between two commands
                driver.signal(signal.SIGKILL)
                driver.ended(5.0)
                killed = time.monotonic()
            rest = steps.find(lambda step: speed(step) == 0.0, 5.0, "at rest", after=killed).value
            state = states.find(
                lambda state: seconds(state["stamp"]) >= stamp(rest),  # noqa: B023
                5.0, "the state at rest", after=killed,
            ).value  # fmt: skip
            age = next(source["age"] for source in state["sources"] if source["name"] == "app")
            accepted = seconds(state["stamp"]) - age
            # If the commander is killed early, its last command may still find the robot on its way
            # up.
            rest_of_it = [entry.value for entry in steps.seen if stamp(entry.value) > accepted]
            full = itertools.dropwhile(lambda step: speed(step) < 0.0999, rest_of_it)
            slower = next(step for step in full if speed(step) < 0.0999)
            until(lambda: peer.lines[-1].line == ZERO_TEXT, 5.0, "zero on the wire")
            line = next(h for h in peer.since(steady) if not h.line.startswith(text(0.1)))
            since, step = accepted - wall, stamp(slower) - wall
            ramps.append(
                Ramp(step - since - lost(since, step), line.at - since - lost(since, line.at))
            )
    took, lines = [ramp.step for ramp in ramps], [ramp.line for ramp in ramps]
    promised = TIMEOUT_S + TICK_S
    late = [delay - promised for delay in took if delay > promised]
    print(
        f"SIGKILL of a commander, last accepted command -> first slower step: "
        f"{count - len(late)} of {count} within {promised * 1e3:.0f} ms, "
        f"{len(late)} by a late tick up to {max(late, default=0.0) * 1e3:.2f} ms over; "
        f"min {min(took) * 1e3:.1f} median {statistics.median(took) * 1e3:.1f} "
        f"max {max(took) * 1e3:.2f} ms; its line at the far end: "
        f"{sum(delay <= promised for delay in lines)} within, "
        f"median {statistics.median(lines) * 1e3:.1f} max {max(lines) * 1e3:.2f} ms"
    )
    return ramps


def stamp(step: Any) -> float:
    return seconds(step["header"]["stamp"])


def speed(step: Any) -> float:
    return float(step["twist"]["linear"]["x"])


LONG = (pytest.mark.soak, pytest.mark.timeout(1200))


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, pytest.param(200, marks=LONG)])
def test_when_a_commander_is_killed_the_ramp_starts_within_its_timeout_and_a_tick(
    far: tuple[FarPeer, Daemon], count: int
) -> None:
    ramps = killed_commanders(*far, count)
    assert max(ramp.step for ramp in ramps) <= TIMEOUT_S + TICK_S + LATE_S
    assert max(ramp.line for ramp in ramps) <= TIMEOUT_S + TICK_S + SLACK_S


# the cable


def kinds_of(pid: int) -> tuple[int, int]:
    """Return the number of file descriptors and of threads of a process."""
    return len(os.listdir(f"/proc/{pid}/fd")), len(os.listdir(f"/proc/{pid}/task"))


@contextmanager
def pty_name_occupied(name: str) -> Iterator[None]:
    """Occupy the pty of this name, so that the next program that opens a pty gets another name."""
    pairs: list[tuple[int, int]] = []

    def hold() -> bool:
        # The name is free once the daemon has closed its end, too. Others may be free before it.
        some = [pty.openpty() for _ in range(8)]
        for ends in some:
            if os.ttyname(ends[1]) == name:
                pairs.append(ends)
            else:
                for end in ends:
                    os.close(end)
        return bool(pairs)

    until(hold, 5.0, f"{name} is free")
    try:
        yield
    finally:
        for end in pairs[0]:
            os.close(end)


def replugged(tmp_path: Path, peer: Peer, cycles: int) -> tuple[list[float], list[float]]:
    """Unplug and replug the board `cycles` times.

    Returns the times until `state` shows the unplugging, and the times from the replugging to the
    first line of zeros, in s. Both are without the time lost to other programs.
    """
    noticed, zeros = [], []
    with (
        Daemon(tmp_path, peer.path) as daemon,
        Bus(daemon.endpoint) as bus,
        bus.follow("state") as states,
    ):
        bus.linked()
        before = (0, 0)
        for cycle in range(cycles + 1):
            name = os.readlink(peer.path)
            pulled = peer.unplug()
            down = states.find(lambda state: state["link"] == "down", 5.0, "down", after=pulled)
            with pty_name_occupied(name):
                peer.plug()
            plugged = time.monotonic()
            assert os.readlink(peer.path) != name
            first = until(lambda: peer.lines[1:2], 5.0, "the first line")[0]
            states.find(lambda state: state["link"] == "up", 5.0, "up", after=down.at)
            assert peer.session.stream.startswith(b"\r\n" + ZERO_LINE)
            assert set(peer.session.raw_lines()[1:]) == {ZERO_LINE}
            if cycle == 0:
                # The first loss may start a thread that stays.
                before = kinds_of(daemon.pid)
                continue
            noticed.append(down.at - pulled - lost(pulled, down.at))
            zeros.append(first.at - plugged - lost(plugged, first.at))
        until(
            lambda: kinds_of(daemon.pid) <= before,
            3.0,
            f"descriptors and threads were {before}, are {kinds_of(daemon.pid)}",
        )
        after = kinds_of(daemon.pid)
    print(
        f"{cycles} unplugs: seen in state after median {statistics.median(noticed) * 1e3:.1f} "
        f"max {max(noticed) * 1e3:.1f} ms; replug under a new name -> first zero line median "
        f"{statistics.median(zeros):.3f} max {max(zeros):.3f} s; file descriptors and threads "
        f"{before} -> {after}"
    )
    assert after[0] <= before[0]
    assert after[1] <= before[1]
    return noticed, zeros


@pytest.mark.slow
@pytest.mark.parametrize("cycles", [3, pytest.param(200, marks=LONG)])
def test_an_unplug_is_seen_and_a_replug_under_another_name_found_in_time_without_leaks(
    tmp_path: Path, peer: Peer, cycles: int
) -> None:
    noticed, zeros = replugged(tmp_path, peer, cycles)
    assert statistics.median(noticed) <= 0.02
    assert max(noticed) <= 0.02 + SLACK_S
    assert max(zeros) <= 0.5 + SLACK_S


# the far end does not read


@pytest.mark.slow
def test_a_board_that_stops_reading_and_answering_is_sent_few_drive_lines_then_zeros(
    tmp_path: Path, peer: Peer
) -> None:
    with (
        Daemon(tmp_path, peer.path) as daemon,
        Bus(daemon.endpoint) as bus,
        bus.commanding(0.5),
    ):
        until(lambda: peer.lines[-1].line.startswith(text(0.5)), 5.0, "steady driving")
        with peer.deaf():
            begun, known = time.monotonic(), len(peer.lines)
            until(lambda: time.monotonic() > begun + 1.0, 5.0, "a second")
            end = time.monotonic()
        until(lambda: peer.lines[-1].at > end + 0.005, 5.0, "it has read what waited")
        lines = [entry.line for entry in peer.lines[known:] if entry.at < end + 0.005]
        drive = [line for line in lines if line != ZERO_LINE]
        first_zero = lines.index(ZERO_LINE)
        print(
            f"deaf for 1 s: {len(lines)} lines waited, {len(drive)} of them drive lines "
            f"(quiet is 10 periods), all {len(lines) - first_zero} behind them zeros"
        )
        assert set(lines[first_zero:]) == {ZERO_LINE}
        assert len(drive) <= 10 + 2
        # Zeros at 10 Hz.
        assert len(lines) - first_zero <= 10 * (end - begun) + 2


@pytest.mark.slow
def test_no_line_waits_in_the_daemon_while_the_serial_line_is_full(
    tmp_path: Path, peer: Peer
) -> None:
    # Feedback goes on, so only the kernel's refusal shows that nothing goes out.
    with (
        Daemon(tmp_path, peer.path) as daemon,
        Bus(daemon.endpoint) as bus,
        bus.commanding(0.5) as driver,
    ):
        until(lambda: peer.lines[-1].line.startswith(text(0.5)), 5.0, "steady driving")
        with peer.deaf():
            stuffed = time.monotonic()
            noise, known = [peer.stuff()], len(peer.lines)

            def no_room() -> bool:
                # The kernel moves accepted bytes on to the reader's buffer, which makes room again.
                noise.append(peer.stuff())
                return noise[-3:] == [0, 0, 0]

            until(no_room, 5.0, "no room is left")
            size, begun = sum(noise), time.monotonic()
            before, lost_links = bus.state(), len(daemon.events("link_stale"))
            driver.wish = twist(0.2)
            spoke, silent = begun, 0.0
            while (now := time.monotonic()) < begun + 0.2:
                spoke, silent = now, max(silent, now - spoke)
                peer.send(PLAIN((10.0,) * 4))
                time.sleep(TICK_S)
            after = bus.state()
            ended = time.monotonic()
        until(lambda: len(peer.lines) > known + size // 2 + 1, 5.0, "it reads again")
        reads, lines = time.monotonic(), [entry.line for entry in peer.lines if entry.line.strip()]
        later = bus.state()
        full, freed = Periods.between(before, after), Periods.between(after, later)
        print(
            f"full for {ended - begun:.2f} s: the kernel held {size} bytes of noise and took "
            f"{full.sent} lines, {full.superseded} superseded, link {after['link']}; then "
            f"{freed.sent} lines in {freed.elapsed:.1f} periods"
        )
        # The exception is a daemon or a peer that had no core for as long as a link may be silent.
        starved = silent > 0.05 or full.latest > 5.0 or lost(begun, ended) > 0.02
        assert after["link"] == "up" or starved or ended - stuffed > GIVEN_UP_S
        # While the link is lost, even for a moment, the daemon makes no lines for it.
        linked = len(daemon.events("link_stale")) == lost_links
        assert linked or starved or reads - stuffed > GIVEN_UP_S
        assert not linked or full.superseded + full.missed >= 15
        assert not linked or full.are_all_accounted_for()
        # A line counts as sent when the kernel takes it. One more than these may be torn.
        assert len(lines) <= later["counters"]["lines_sent"] + 1
        # The kernel moves bytes on while the daemon waits, but these make room for few lines.
        assert full.sent <= 4
        # Of the lines of all these periods only the newest follows. A line goes out for each
        # command, for each period, and for one at either end.
        assert freed.sent <= freed.elapsed + freed.commands + 3

        def obeyed() -> bool:
            # A busy machine may deliver our replies in one burst, which no wheel could produce.
            state = bus.state()
            if state["mode"] == "fault":
                bus.get("srv/clear")
            driver.wish = ZERO if state["code"] == "neutral" else twist(0.2)
            return peer.lines[-1].line.startswith(text(0.2))

        # After a long silence the MCU has stopped, so the daemon starts over from zero.
        until(obeyed, 5.0, "the newest command")


# no processor time


def busy(where: Path) -> ExitStack:
    """Run two processes per core that use all the time they get."""
    stack = ExitStack()
    for _ in range(2 * (os.cpu_count() or 1)):
        stack.enter_context(Program(command_line(BUSY), where))
    return stack


def unheard(states: Following, since: float, to: float) -> float:
    """Return the largest age of the last command of `app` in the states of this time, s.

    It is larger than the timeout if a command waited for a core. `state` is also published at the
    moment when the mode changes because commands are missing.
    """
    ages = [
        source["age"] or 0.0
        for entry in states.seen
        if since <= entry.at <= to
        for source in entry.value["sources"]
        if source["name"] == "app"
    ]
    return max(ages, default=0.0)


def starved(peer: FarPeer, daemon: Daemon, length: float) -> None:
    with (
        Bus(daemon.endpoint) as bus,
        commander(daemon, 0.3) as driver,
        bus.follow("cmd_vel_out") as steps,
        bus.follow("state") as states,
    ):
        drives(peer, driver)
        with busy(daemon.config.parent):
            # The message is published after a step, so that stamp and counters belong together.
            begun, ended = time.monotonic(), time.monotonic() + length
            before = states.find(lambda _: True, 5.0, "a state", after=begun).value
            after = states.find(lambda _: True, length + 5, "a later one", after=ended).value
            # The peer's own times are in doubt too, because it has no core either.
            ended, waited = time.monotonic(), kept_waiting(daemon.pid) + kept_waiting(peer.pid)
            driver.signal(signal.SIGKILL)
            driver.ended(5.0)
            sent = last_put(driver)
            peer.awaits(ZERO_TEXT, after=sent)
            waited = kept_waiting(daemon.pid) + kept_waiting(peer.pid) - waited
        puts = puts_of(driver)
        silent = max(b - a for a, b in itertools.pairwise([begun, *puts, ended]) if begun < b)
        lines = peer.since(begun, ended)
        slower = next(h for h in peer.since(sent) if not h.line.startswith(text(0.3)))
    stamps = [seconds(step.value["header"]["stamp"]) for step in steps.seen]
    steps_apart = [b - a for a, b in itertools.pairwise(stamps)]
    apart = min(steps_apart)
    periods, between = Periods.between(before, after), gaps(lines)
    close = sum(gap < WIRE_S for gap in between)
    print(
        f"starved for {length:g} s: {periods.sent} sent, {periods.superseded} superseded, "
        f"{periods.missed} missed of {periods.elapsed:.0f} periods, "
        f"{periods.elapsed - periods.accounted:+.1f} unaccounted; steps at least "
        f"{apart * 1e3:.2f} ms apart; {len(lines)} lines at the other end of the pty, at most "
        f"{max(between) * 1e3:.1f} ms apart, {close} closer than a line's time; ramp "
        f"{slower.at - sent:.3f} s after the last command"
    )
    # A link that was lost may have periods without a line.
    assert periods.are_all_accounted_for() or broken(states, begun, ended)
    # The lines are counted, not timed: the kernel's thread that carries bytes through a pty starves
    # as well, and then delivers several lines at once.
    assert len(lines) <= 100 * (ended - begun) + 5
    # The commander starves, too, and so does the link. A loop that had no core for as long as a
    # command counts starts again from zero.
    stood = max(silent, unheard(states, begun, ended), *steps_apart)
    if stood < TIMEOUT_S - TICK_S and not broken(states, begun, ended):
        assert {h.line for h in lines} <= {text(0.3) + b"bp06.00,cp06.00,dp06.00"}
    assert slower.at - sent <= TIMEOUT_S + TICK_S + SLACK_S + lost(sent, slower.at) + waited


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.6, pytest.param(60.0, marks=pytest.mark.soak)])
def test_starved_of_both_cores_every_missed_period_is_counted_and_none_made_up_in_a_burst(
    far: tuple[FarPeer, Daemon], length: float
) -> None:
    starved(*far, length)


@contextmanager
def stalled(daemon: Daemon) -> Iterator[None]:
    """Stop the whole daemon process while the body runs."""
    daemon.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        daemon.signal(signal.SIGCONT)


def no_burst(lines: list[ReceivedLine]) -> float:
    """Check that lines do not come in a burst, and return the smallest gap between two lines.

    The lines in each tenth of a second are counted. Two or three more than the control rate are
    allowed, and further ones if the machine was busy, because the kernel's thread for the pty may
    deliver several lines at once.
    """
    for first in lines:
        most = 10 + 4
        if (count := sum(first.at <= entry.at < first.at + 0.1 for entry in lines)) > most:
            # The line that waited longest was written that much earlier. A process that reads all
            # the time waits longer than one that only checks the clock.
            most += 2 + round(3 * lost(first.at - 0.5, first.at + 0.1) / TICK_S)
        assert count <= most
    return min(gaps(lines), default=0.0)


@pytest.mark.slow
def test_after_half_a_second_s_stall_no_speed_is_resumed_for_a_commander_that_has_gone(
    far: tuple[FarPeer, Daemon],
) -> None:
    peer, daemon = far
    with commander(daemon, 0.3) as driver:
        drives(peer, driver)
        with stalled(daemon):
            begun, count = time.monotonic(), len(driver.out)
            until(lambda: len(driver.out) >= count + 3, 5.0, "commands pile up")
            driver.signal(signal.SIGKILL)
            driver.ended(5.0)
            until(lambda: time.monotonic() > begun + 0.5, 5.0, "half a second")
            woken = time.monotonic()
        until(lambda: len(peer.since(woken)) > 30, 5.0, "30 lines")
        print(f"stall: smallest gap after it {no_burst(peer.since(woken)) * 1e3:.2f} ms")
        assert {entry.line for entry in peer.since(woken)} == {ZERO_TEXT}


@pytest.mark.slow
def test_after_a_stall_of_seconds_a_commander_that_goes_on_must_be_neutral_first(
    far: tuple[FarPeer, Daemon],
) -> None:
    peer, daemon = far
    # The stall is shorter than the 2 s after which clients give the daemon up and reconnect.
    with commander(daemon, 0.3) as driver:
        drives(peer, driver)
        with stalled(daemon):
            begun = time.monotonic()
            until(lambda: time.monotonic() > begun + 1.2, 5.0, "seconds")
            woken = time.monotonic()
        with Bus(daemon.endpoint) as bus:
            until(lambda: bus.state()["code"] == "neutral", 5.0, "what it waits for")
            until(lambda: len(peer.since(woken)) > 30, 5.0, "30 lines")
            assert no_burst(peer.since(woken)) >= 0.0
            assert {entry.line for entry in peer.since(woken)} == {ZERO_TEXT}
            driver.process.send_signal(signal.SIGUSR1)
            peer.awaits(text(0.3), after=woken)


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_after_50_stalls_of_any_length_the_first_line_is_zero_and_none_comes_in_a_burst(
    tmp_path: Path,
) -> None:
    rng, least, resumed = random.Random(2), 1.0, 0
    with robot(tmp_path) as (peer, daemon):
        for _ in range(50):
            with commander(daemon, 0.2):
                peer.awaits(text(0.2), after=time.monotonic())
                with stalled(daemon):
                    begun, length = time.monotonic(), rng.uniform(0.3, 3.0)
                    until(lambda: time.monotonic() > begun + length, 9.0, "a stall")  # noqa: B023
                    woken = time.monotonic()
                until(lambda: len(peer.since(woken)) > 30, 5.0, "30 lines")  # noqa: B023
                lines = peer.since(woken)
                resumed += lines[0].line != ZERO_TEXT
                least = min(least, no_burst(lines))
            until(lambda: peer.lines[-1].line == ZERO_TEXT, 5.0, "at rest")
    print(f"50 stalls of 0.3 to 3 s: {resumed} resumed a speed, smallest gap {least * 1e3:.2f} ms")
    assert resumed == 0


# output that blocks
