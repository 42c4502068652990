"""The real daemon drives the firmware's machine code in a simulator, in real time.

The tests compare its odometry with the counts and the motion of the simulated motors. A client on
the bus sends the commands.
"""

from __future__ import annotations

import itertools
import math
import random
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.firmware.board import MS, Board, Host, Identity, Status, passes
from tests.firmware.conftest import BUMPERS, ESTOP, FREE_SPEEDS, wired_board
from tests.system.harness import (
    ZERO,
    Bus,
    Commander,
    Daemon,
    Following,
    seconds,
    twist,
    until,
)

pytestmark = pytest.mark.firmware


RADIUS, TRACK = 0.05, 0.3
"""m, as in the daemon's configuration."""

ANGLE = math.tau / 3200
"""rad a count."""

COAST = 0.035
"""m. A wheel at 0.5 m/s rolls 25 mm without voltage."""

JITTER = 0.01
"""m at 0.5 m/s: the stamps of two samples may be 20 ms nearer than the samples were."""

BOOT_NS = 1 * MS
"""After a reset the memory still shows the earlier wish for this time."""

Mcu = Mapping[str, object]

PLAIN: Mcu = {"link_check": "off"}

CHECKED: Mcu = {"link_check": "on", "encoder_counts": 3200}

LEGS = [(0.6, 0.0), (0.6, 0.9), (0.0, 1.5), (0.8, -0.4), (-0.3, 0.0), (0.0, 0.0)]
"""m/s and rad/s: ramps, arcs, a turn on the spot, back, a stop. They move every wheel forward."""

LEG_MS = 1200

soak = pytest.mark.soak


class Rig(NamedTuple):
    """A simulated board, the daemon that drives it, and a client on the bus."""

    board: Board
    daemon: Daemon
    bus: Bus


@contextmanager
def running(
    board: Board, where: Path, mcu: Mcu, port: Path | str = "", **tables: Mapping[str, object]
) -> Iterator[Rig]:
    """Run a daemon on the board's port and a client. The body runs when the link is up."""
    config = {"mcu": mcu, **tables}
    with Daemon(where, port or board.path, config) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        yield Rig(board, daemon, bus)


def turns(board: Board, speed: float) -> Status | None:
    """Return the board's state if all wheels have this speed in rad/s, otherwise None."""
    status = board.status()
    return status if all(abs(motor.speed - speed) < 0.1 for motor in status.motors) else None


def drives(board: Board, linear: float = 0.5, within: float = 5.0) -> Status:
    """Wait until the robot drives straight at this speed in m/s. Return the board's state."""
    return until(lambda: turns(board, linear / RADIUS), within, f"it drives at {linear} m/s")


def wait_until_still(board: Board) -> Status:
    """Wait until no wheel turns or has voltage. Return the board's state."""

    def look() -> Status | None:
        status = board.status()
        still = all(motor.speed == 0.0 and motor.duty == 0.0 for motor in status.motors)
        return status if still else None

    return until(look, 10.0, "the wheels stand")


def gives_way(bus: Bus, commander: Commander, linear: float = 0.5) -> None:
    """Send zeros until the sender is armed, and then a speed in m/s.

    A sender that is known only by its key must send zeros for a second before it is armed.
    """
    commander.wish = ZERO
    until(lambda: bus.state()["code"] != "neutral", 5.0, "neutral")
    commander.wish = twist(linear)


def moves_nothing(board: Board, since: Status, ms: float) -> None:
    """Check that the firmware has commanded no motion since `since`, and wait `ms` more of it.

    Motors that coasted at a reset are braked, so they turn only a little further.
    """
    status = passes(board, ms)
    assert status.wanted_ns < since.virtual_ns + BOOT_NS, "not for a moment"
    for before, after in zip(since.motors, status.motors, strict=True):
        assert after.speed == 0.0
        assert abs(after.counts - before.counts) * ANGLE * RADIUS < COAST


def drive_about(board: Board, commander: Commander, length_s: float) -> None:
    """Drive the legs of `LEGS` one after the other for `length_s`, and end with a zero."""
    end = board.status().virtual_ns + length_s * 1000 * MS
    for leg in itertools.cycle(LEGS):
        commander.wish = twist(*leg)
        if passes(board, LEG_MS).virtual_ns >= end:
            break
    commander.wish = ZERO


def skipped(status: Status) -> str:
    """Return a text with the simulated time that this busy machine skipped.

    A test that fails prints it, because a board that skips time is not realistic.
    """
    return f"{status.skipped_ns / MS:.0f} ms skipped for want of a faster machine"


def account(board: Board) -> Identity:
    """Return the board's counters. No other program may have the board's port open."""
    with Host(board.path) as host:
        return host.identity()


# odometry compared with the truth


class Path2D(NamedTuple):
    """The path of the robot."""

    distance: float
    """m, forward less backward."""
    yaw: float
    """rad; whole turns count."""


def pose(message: Any) -> tuple[float, float, float]:
    """Return x (m), y (m) and yaw (rad) of an odometry message."""
    position, turn = message["pose"]["pose"]["position"], message["pose"]["pose"]["orientation"]
    return position["x"], position["y"], 2 * math.atan2(turn["z"], turn["w"])


def went(odom: Sequence[Any]) -> Path2D:
    """Return the distance and turn of a series of odometry messages that starts at the origin."""
    distance = total = 0.0
    x, y, yaw = 0.0, 0.0, 0.0
    for message in odom:
        to_x, to_y, to_yaw = pose(message)
        turn = math.remainder(to_yaw - yaw, math.tau)
        heading = yaw + turn / 2
        distance += (to_x - x) * math.cos(heading) + (to_y - y) * math.sin(heading)
        total += turn
        x, y, yaw = to_x, to_y, to_yaw
    return Path2D(distance, total)


def truly(status: Status) -> Path2D:
    """Return the true distance and turn, computed from the simulated encoders."""
    a, b, c, d = (motor.counts * ANGLE * RADIUS for motor in status.motors)
    right, left = (a + d) / 2, (b + c) / 2
    return Path2D((right + left) / 2, (right - left) / TRACK)


def leap(odom: Sequence[Any], fastest: float) -> float:
    """Return the longest jump of the odometry, in m.

    A jump is the distance between two messages beyond the distance at `fastest` m/s.
    """
    most = -math.inf
    for before, after in itertools.pairwise(odom):
        (x, y, _), (to_x, to_y, _) = pose(before), pose(after)
        dt = seconds(after["header"]["stamp"]) - seconds(before["header"]["stamp"])
        most = max(most, math.hypot(to_x - x, to_y - y) - fastest * dt)
    return most


class Errors(NamedTuple):
    """Relative errors of the odometry and the wheel angles, compared with the simulated motors."""

    distance: float
    yaw: float
    wheels: tuple[float, ...]

    @property
    def worst(self) -> float:
        return max(abs(self.distance), abs(self.yaw), *map(abs, self.wheels))

    def __str__(self) -> str:
        wheels = ", ".join(f"{wheel:+.3%}" for wheel in self.wheels)
        return f"distance {self.distance:+.3%}, yaw {self.yaw:+.3%}, wheels {wheels}"


def errors(odom: Following, wheels: Following, true: Status) -> Errors:
    """Return the relative errors of the odometry. The robot must be at rest."""
    now = time.monotonic()
    odom.find(lambda message: True, 3.0, "odometry at rest", after=now)
    turned = wheels.find(lambda message: True, 3.0, "wheels at rest", after=now).value["position"]
    odometry, right = went([entry.value for entry in odom.seen]), truly(true)
    angles = [motor.counts * ANGLE for motor in true.motors]
    assert min(map(abs, angles)) > 10.0, "far enough to tell"
    shares = tuple(a / b - 1 for a, b in zip(turned, angles, strict=True))
    return Errors(odometry.distance / right.distance - 1, odometry.yaw / right.yaw - 1, shares)


# driving


@pytest.mark.parametrize("mcu", [PLAIN, CHECKED], ids=["plain", "counts"])
@pytest.mark.parametrize("length_s", [8, pytest.param(60, marks=soak)])
@pytest.mark.timeout(180)
def test_every_line_is_executed_and_odometry_agrees_with_the_wheels(
    board: Board, tmp_path: Path, mcu: Mcu, length_s: int
) -> None:
    with running(board, tmp_path, mcu) as (_, daemon, bus):
        with bus.follow("odom") as odom, bus.follow("wheel_states") as wheels:
            began = board.status()
            with bus.commanding(0.0) as commander:
                drive_about(board, commander, length_s)
                status = wait_until_still(board)
            off_by = errors(odom, wheels, status)
        state = bus.at_rest()
        daemon.signal(signal.SIGTERM)
        assert daemon.ended(3.0) == 0
    ended = passes(board, 50)
    asked = ended.to_board.lines - 1  # one is the question of the session: no speeds
    counted = account(board)
    counters = state["counters"]
    rate = (status.to_board.lines - began.to_board.lines) / (
        (status.virtual_ns - began.virtual_ns) / 1e9
    )
    print(f"\n{asked} lines ({counters['lines_sent']} by the daemon before its end), {rate:.1f}/s; "
          f"{counted.lines} executed = {counted.lines / asked:.3%}, {counted.refused} refused, "
          f"{counted.trips} trips; {ended.set_points} set points, {ended.wrong} wrong; "
          f"missed periods {counters.get('missed_periods', 0)}, superseded "
          f"{counters.get('lines_superseded', 0)}, "
          f"link stale {len(daemon.events('link_stale'))} times, {skipped(ended)}")  # fmt: skip
    print(f"odometry: {off_by}")
    assert counted.lines >= 0.999 * asked
    assert asked >= counters["lines_sent"]
    assert rate > 95
    assert (counted.refused, counted.trips, ended.wrong) == (0, 0, 0)
    assert (ended.resets, counted.reset) == (0, "power")
    assert ended.set_points > 100
    assert off_by.worst < 0.02


# the host ends


@pytest.mark.parametrize("times", [2, pytest.param(100, marks=soak)])
@pytest.mark.timeout(900)
def test_when_the_daemon_is_killed_the_motors_stop(
    board: Board, tmp_path: Path, times: int
) -> None:
    rng = random.Random(times)
    silent, wall = [], []
    for _ in range(times):
        wish = rng.choice([(0.5, 0.0), (-0.3, 0.0), (0.0, 1.5), (0.4, -0.8)])
        mcu = rng.choice([PLAIN, CHECKED])
        with running(board, tmp_path, mcu) as (_, daemon, bus), bus.commanding(*wish):
            until(lambda: board.status().running, 5.0, "it drives")
            passes(board, rng.uniform(20.0, 600.0))
            daemon.signal(signal.SIGKILL)
            killed = time.monotonic_ns()
            daemon.ended(3.0)
            status = until(
                lambda: None if (status := board.status()).running else status, 3.0, "motors off"
            )
        assert status.to_board.last.startswith("a"), "a whole line was the last"
        silent.append((status.off_ns - status.heard_ns) / MS)
        wall.append((status.base_ns + status.off_ns - killed) / MS)
    counted = account(board)
    within = sum(ms <= 350 for ms in silent)
    print(f"\nkilled while driving: {within} of {times} within 350 ms of the last line: "
          f"{min(silent):.1f} to {max(silent):.1f} ms; {min(wall):.0f} to {max(wall):.0f} ms after "
          f"the signal (wall clock); the board counted {counted.trips}")  # fmt: skip
    assert within == times
    assert min(silent) >= 250
    assert counted.trips == times
    assert (counted.refused, board.status().wrong) == (0, 0)


# the board ends


def by_pin(board: Board) -> None:
    """Reset the board as a person does who presses its reset button."""
    board.command("reset")


def by_a_hang(board: Board) -> None:
    """Make the main loop of the firmware hang, so that the hardware watchdog resets the board."""
    board.command("type !l")


def unheard(board: Board) -> None:
    """Reset the board through its pin, and lose the line that it sends after the boot."""
    lines = board.status().from_board.lines
    board.command("lose from 100")
    board.command("reset")
    until(lambda: board.status().from_board.lines > lines, 3.0, "it has said that it booted")
    board.command("lose from 0")


def resets(rig: Rig, how: Callable[[Board], None], unseen: float) -> None:
    """Reset the board while the robot drives, and check that it stops and its odometry stays right.

    The commander sends on all the time. `unseen` is the distance in m that the board does not
    report. The odometry may lack at most this distance, and may not add any.
    """
    board, _, bus = rig
    with bus.follow("odom") as odom:
        with bus.commanding(0.5) as commander:
            passes(board, 200)
            drives(board)
            how(board)
            off = until(lambda: s if (s := board.status()).resets else None, 3.0, "a reset")
            assert not off.running
            moves_nothing(board, off, 800)
            state = bus.state()
            assert (state["link"], state["mode"]) == ("up", "ready")
            (waiting,) = [source for source in state["sources"] if source["name"] == "app"]
            assert waiting["waits_for"].startswith("send a zero first")
            coasted = truly(wait_until_still(board))
            gives_way(bus, commander)
            drives(board)
        true = truly(wait_until_still(board))
        bus.at_rest()
        now = time.monotonic()
        odom.find(lambda message: True, 3.0, "odometry at rest", after=now)
    odometry = went([entry.value for entry in odom.seen])
    most = leap([entry.value for entry in odom.seen], 0.5)
    print(f"\n{how.__name__}: {true.distance:.3f} m, odometry "
          f"{1000 * (odometry.distance - true.distance):+.1f} mm off; "
          f"longest step {1000 * most:+.2f} mm beyond 0.5 m/s")  # fmt: skip
    assert coasted.distance > 0.05
    assert -unseen < odometry.distance - true.distance < 0.002
    assert abs(odometry.yaw - true.yaw) < 0.02
    assert most < JITTER
    assert board.status().wrong == 0


MODES = {"off": PLAIN, "on": CHECKED}


@pytest.mark.parametrize("mode", ["on", pytest.param("off", marks=soak)])
def test_a_board_that_is_reset_does_not_move_before_neutral(
    board: Board, tmp_path: Path, mode: str
) -> None:
    with running(board, tmp_path, MODES[mode]) as rig:
        resets(rig, by_pin, unseen=0.035)
    assert account(board).reset == "pin"


@pytest.mark.parametrize("mode", ["off", pytest.param("on", marks=soak)])
def test_a_board_with_an_unreported_reset_does_not_move_before_neutral(
    board: Board, tmp_path: Path, mode: str
) -> None:
    with running(board, tmp_path, MODES[mode]) as rig:
        resets(rig, unheard, unseen=0.05)


@pytest.mark.parametrize("mode", ["on", pytest.param("off", marks=soak)])
def test_a_board_that_hung_does_not_move_before_neutral(
    runner: Path, hanging_firmware: Path, tmp_path: Path, mode: str
) -> None:
    with Board(runner, hanging_firmware, "--free-speed", FREE_SPEEDS) as board:
        with running(board, tmp_path, MODES[mode]) as rig:
            resets(rig, by_a_hang, unseen=0.1)
        assert account(board).reset == "watchdog"


# the emergency stop


def drives_in_the_end(board: Board, bus: Bus, commander: Commander) -> None:
    """Wait until the robot drives, and release it if it waits.

    On a busy machine the link may have been lost. Then the robot waits for zeros or for `clear`,
    and this function sends them.
    """

    def look() -> Status | None:
        state = bus.state()
        if state["mode"] == "stopped":
            bus.get("srv/clear")
        if state["code"] == "neutral":
            gives_way(bus, commander)
        return turns(board, 0.5 / RADIUS)

    until(look, 10.0, "it drives")


@pytest.mark.parametrize(
    ("mcu", "rate"),
    [(CHECKED, 100), ({"baud_rate": 9600}, 10)],
    ids=["115200 baud", "9600 baud"],
)
def test_a_press_at_the_robot_stops_it_and_clear_is_refused_until_the_release(
    runner: Path, wired: dict[int, Path], tmp_path: Path, mcu: Mcu, rate: int
) -> None:
    baud = 9600 if "baud_rate" in mcu else 115200
    safety, control = {"estop": "required"}, {"rate": rate}
    with (
        wired_board(runner, wired, baud) as board,
        running(board, tmp_path, mcu, safety=safety, control=control) as (_, _, bus),
        bus.commanding(0.5) as commander,
    ):
        drives_in_the_end(board, bus, commander)
        passes(board, 1500)
        drives_in_the_end(board, bus, commander)
        board.command(f"contact {ESTOP} open")
        state = until(lambda: s if (s := bus.state())["mode"] == "stopped" else None, 3.0, "a stop")
        assert state["emergency_stop"] == "pressed"
        assert state["code"] == "emergency_stop"
        off = wait_until_still(board)
        assert "p00.00,bp00.00,cp00.00,dp00.00" in off.to_board.last
        refused = bus.get("srv/clear")
        assert not refused["success"], refused
        moves_nothing(board, off, 600)
        board.command(f"contact {ESTOP} closed")
        until(lambda: bus.state()["emergency_stop"] == "released", 3.0, "the release")
        moves_nothing(board, off, 600)
        assert bus.get("srv/clear")["success"]
        moves_nothing(board, off, 300)
        drives_in_the_end(board, bus, commander)
        board.command(f"contact {BUMPERS[1]} open")
        passes(board, 1500)
        (row,) = [
            entry for entry in bus.get("diagnostics")["status"] if entry["name"].endswith("board")
        ]
        values = {entry["key"]: entry["value"] for entry in row["values"]}
        counters = bus.state()["counters"]
        print(f"\n{baud} baud, {rate} Hz: {values}; emergency stops "
              f"{counters['emergency_stops']}")  # fmt: skip
        assert values["bumpers"] == ".X.."
        assert values["motor_driver"] == "ok"
        assert float(values["volts"]) == pytest.approx(24.0, abs=0.1)
        assert float(values["amperes"]) == pytest.approx(0.0, abs=0.2)
        assert counters["emergency_stops"] == 1 or board.status().skipped_ns > 0, counters
        assert not any(name.startswith("line_status") for name in counters), counters


# the wire


@pytest.mark.parametrize(
    "mcu", [pytest.param(PLAIN, marks=soak), CHECKED], ids=["plain", "checked"]
)
@pytest.mark.parametrize("length_s", [1.5, pytest.param(20.0, marks=soak)])
def test_a_bad_wire_costs_lines_and_no_wheel_a_wrong_speed(
    board: Board, tmp_path: Path, mcu: Mcu, length_s: float
) -> None:
    """In each direction, one line in four to six has a wrong bit, and later a lost byte.

    On the checked link the robot drives on and executes no wrong speed.
    """
    is_checked = mcu is CHECKED
    with running(board, tmp_path, mcu) as (_, _, bus), bus.commanding(0.5) as commander:
        drives(board)
        for fault in ("noise", "drop"):
            before, status, speeds = bad_wire(board, fault, length_s)
            for _ in range(2):
                if not is_checked or status.skipped_ns == before.skipped_ns:
                    break
                # The machine was so busy that the simulated board stood still, so lines came late.
                drives(board)
                before, status, speeds = bad_wire(board, fault, length_s)
            points, wrong = status.set_points - before.set_points, status.wrong - before.wrong
            lines = status.to_board.lines - before.to_board.lines
            bad = status.to_board.damaged + status.to_board.lost
            bad -= before.to_board.damaged + before.to_board.lost
            state = bus.state()
            print(f"\n{fault}: {lines} lines with {bad} bad bytes: {points} changes of set points, "
                  f"{wrong} to speeds nobody asked for {list(status.wrong_one) if wrong else ''}; "
                  f"slowest wheel {min(speeds):.2f} rad/s, then {state['mode']}, "
                  f"link {state['link']}; {skipped(status)}")  # fmt: skip
            if is_checked:
                assert wrong == 0
                assert state["mode"] == "driving"
                assert min(speeds) > 9.5
            elif state["mode"] == "fault":
                bus.get("srv/clear")
                gives_way(bus, commander)
            drives(board)
        print("the daemon refused:", rejects(bus))
    counted = account(board)
    print(f"the board executed {counted.lines} lines and refused {counted.refused}")
    if is_checked:
        assert board.status().wrong == 0
        assert counted.trips == 0


def bad_wire(board: Board, fault: str, length_s: float) -> tuple[Status, Status, list[float]]:
    """Damage lines in both directions for `length_s`.

    `fault` is "noise" (wrong bits) or "drop" (lost bytes). Returns the board's status before and
    after, and the speeds of all motors in between, rad/s.
    """
    before = board.status()
    board.command(f"{fault} to 211")
    board.command(f"{fault} from 307")
    speeds: list[float] = []
    while (status := passes(board, 5)).virtual_ns < before.virtual_ns + length_s * 1e9:
        speeds += [motor.speed for motor in status.motors]
    board.command(f"{fault} to 0")
    board.command(f"{fault} from 0")
    return before, status, speeds


def rejects(bus: Bus) -> dict[str, int]:
    """Return the number of lines that the daemon refused, by reason."""
    counters = bus.state()["counters"]
    return {name: count for name, count in counters.items() if name.startswith("line_")}


@pytest.mark.parametrize(
    "mcu", [pytest.param(PLAIN, marks=soak), CHECKED], ids=["plain", "checked"]
)
def test_a_lost_link_is_restored_and_the_commander_must_be_neutral_first(
    board: Board, tmp_path: Path, mcu: Mcu
) -> None:
    """First the board falls silent, then its plug is pulled. The commander sends all the time.

    The daemon restores the link, and the robot does not move until the commander sends zeros.
    """
    port = tmp_path / "mcu"
    port.symlink_to(board.path)
    with running(board, tmp_path, mcu, port) as (_, daemon, bus), bus.commanding(0.5) as commander:
        with bus.follow("state") as states:

            def link(word: str, since: float) -> float:
                """Wait until `state` reports this link. Return the time since `since` in ms."""
                event = states.find(
                    lambda state: state["link"] == word, 3.0, f"link {word}", after=since
                )
                return 1000 * (event.at - since)

            drives(board)
            at = time.monotonic()
            board.command("mute")
            stale = link("stale", at)
            off = wait_until_still(board)
            stopped = (off.wanted_ns + off.base_ns) / MS - at * 1000
            # After less than a second it would ramp up again by itself.
            passes(board, 1200)
            at = time.monotonic()
            board.command("unmute")
            back = link("up", at)
            moves_nothing(board, off, 600)
            print(f"\nmute -> stale {stale:.0f} ms, told to stop {stopped:.0f} ms; "
                  f"unmute -> up {back:.0f} ms")  # fmt: skip
            assert stale < 200
            assert stopped < 200
            assert back < 600
            gives_way(bus, commander)
            drives(board)

            at = time.monotonic()
            port.unlink()
            board.command("unplug")
            down = link("down", at)
            off = until(lambda: None if (s := board.status()).running else s, 3.0, "motors off")
            silent = (off.off_ns - off.heard_ns) / MS
            port.symlink_to(board.plug())
            at = time.monotonic()
            back = link("up", at)
            moves_nothing(board, off, 600)
            print(f"unplug -> down {down:.0f} ms, no voltage {silent:.0f} ms after the last byte; "
                  f"plug -> up {back:.0f} ms")  # fmt: skip
            assert down < 250
            assert silent <= 350
            assert back < 1500
            gives_way(bus, commander)
            drives(board)
        assert board.status().wrong == 0
        assert daemon.process.poll() is None
    assert account(board).refused <= 1, "a line that the plug cut"


@pytest.mark.parametrize(
    ("mcu", "length_s"),
    [(CHECKED, 5), pytest.param(CHECKED, 60, marks=soak), pytest.param(PLAIN, 60, marks=soak)],
    ids=["counts-5", "counts-60", "plain-60"],
)
@pytest.mark.timeout(180)
@pytest.mark.nightly
def test_with_counts_the_loss_of_a_fifth_of_the_lines_loses_no_distance(
    board: Board, tmp_path: Path, mcu: Mcu, length_s: int
) -> None:
    with running(board, tmp_path, mcu) as (_, daemon, bus):
        with bus.follow("odom") as odom, bus.follow("wheel_states") as wheels:
            board.command("lose from 20")
            with bus.commanding(0.0) as commander:
                drive_about(board, commander, length_s)
                status = wait_until_still(board)
                off_by = errors(odom, wheels, status)
            board.command("lose from 0")
        stale = len(daemon.events("link_stale"))
    wire = status.from_board
    lost = wire.lost / wire.bytes
    print(f"\n{lost:.1%} of {wire.lines} replies lost, link stale {stale} times; {off_by}; "
          f"{skipped(status)}")  # fmt: skip
    assert 0.15 < lost < 0.25
    if mcu is CHECKED:
        assert off_by.worst < 0.001
