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

from tests.firmware.board import MS, Board, Host, Identity, Status
from tests.firmware.conftest import BUMPERS, ESTOP, FREE_SPEEDS, wire
from tests.system.harness import ZERO, Bus, Commander, Daemon, Following, seconds, twist, until

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


@pytest.fixture
def board(runner: Path, firmware: Path) -> Iterator[Board]:
    with Board(runner, firmware, "--free-speed", FREE_SPEEDS, live=True) as board:
        yield board


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


def has_speed(status: Status, linear: float = 0.5) -> bool:
    return all(abs(motor.speed - linear / RADIUS) < 0.1 for motor in status.motors)


def drives(board: Board) -> Status:
    """Wait until the robot drives straight at 0.5 m/s."""
    return board.waits(has_speed, "it drives", 5000.0)


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
    status = board.passes(ms)
    assert status.wanted_ns < since.virtual_ns + BOOT_NS, "not for a moment"
    for before, after in zip(since.motors, status.motors, strict=True):
        assert after.speed == 0.0
        assert abs(after.counts - before.counts) * ANGLE * RADIUS < COAST


def drive_about(board: Board, commander: Commander, length_s: float) -> Status:
    """Drive the legs of `LEGS` one after the other for `length_s`, and come to rest."""
    end = board.status().virtual_ns + length_s * 1000 * MS
    for leg in itertools.cycle(LEGS):
        commander.wish = twist(*leg)
        if board.passes(1200).virtual_ns >= end:
            break
    commander.wish = ZERO
    return board.is_still()


def account(board: Board) -> Identity:
    """Return the board's counters. No other program may have the board's port open."""
    board.pause()
    with Host(board) as host:
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
def test_every_line_is_executed_and_odometry_agrees_with_the_wheels(
    board: Board, tmp_path: Path, mcu: Mcu
) -> None:
    with running(board, tmp_path, mcu) as (_, daemon, bus):
        with bus.follow("odom") as odom, bus.follow("wheel_states") as wheels:
            began = board.status()
            with bus.commanding(0.0) as commander:
                status = drive_about(board, commander, 8.0)
            off_by = errors(odom, wheels, status)
        counters = bus.at_rest()["counters"]
        daemon.signal(signal.SIGTERM)
        assert daemon.ended(3.0) == 0
    ended = board.passes(50)
    asked = ended.to_board.lines - 1  # one is the question of the session: no speeds
    counted = account(board)
    lines, length_s = status.to_board.lines - began.to_board.lines, status.virtual_ns / 1e9
    rate = lines / (length_s - began.virtual_ns / 1e9)
    print(f"\n{rate:.1f} lines/s; {counted.lines} of {asked} executed, {off_by}, "
          f"missed periods {counters.get('missed_periods', 0)}, "
          f"{ended.skipped_ns / MS:.0f} ms skipped for want of a faster machine")  # fmt: skip
    assert counted.lines >= 0.999 * asked
    assert asked >= counters["lines_sent"]
    assert rate > 95
    assert (counted.refused, counted.trips, ended.wrong) == (0, 0, 0)
    assert (ended.resets, counted.reset) == (0, "power")
    assert ended.set_points > 100
    assert off_by.worst < 0.02


# the host ends


def test_when_the_daemon_is_killed_the_motors_stop(board: Board, tmp_path: Path) -> None:
    rng = random.Random(2)
    for mcu, wish in ((PLAIN, (0.5, 0.0)), (CHECKED, (0.4, -0.8))):
        with running(board, tmp_path, mcu) as (_, daemon, bus), bus.commanding(*wish):
            board.waits(lambda status: status.running, "it drives", 5000.0)
            board.passes(rng.uniform(20.0, 600.0))
            daemon.signal(signal.SIGKILL)
            daemon.ended(3.0)
            status = board.waits(lambda status: not status.running, "motors off")
        assert status.to_board.last.startswith("a"), "a whole line was the last"
        silent = (status.off_ns - status.heard_ns) / MS
        print(f"\nkilled while driving: off {silent:.1f} ms after the last line")
        assert 250 <= silent <= 350
    counted = account(board)
    assert (counted.trips, counted.refused, board.status().wrong) == (2, 0, 0)


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
    board.waits(lambda status: status.from_board.lines > lines, "it has said that it booted")
    board.command("lose from 0")


@pytest.mark.parametrize(
    ("how", "mcu", "unseen", "cause"),
    [
        (by_pin, CHECKED, 0.035, "pin"),
        (unheard, PLAIN, 0.05, "pin"),
        (by_a_hang, CHECKED, 0.1, "watchdog"),
    ],
    ids=["by its pin", "unreported", "by a hang"],
)
def test_a_board_that_restarts_while_driving_does_not_move_before_neutral(
    runner: Path, hanging_firmware: Path, tmp_path: Path, how: Callable[[Board], None], mcu: Mcu,
    unseen: float, cause: str,
) -> None:  # fmt: skip
    """The commander sends on all the time, and the odometry stays right.

    `unseen` is the distance in m that the board does not report. The odometry may lack at most this
    distance, and may not add any.
    """
    with Board(runner, hanging_firmware, "--free-speed", FREE_SPEEDS, live=True) as board:
        with running(board, tmp_path, mcu) as (_, _, bus), bus.follow("odom") as odom:
            with bus.commanding(0.5) as commander:
                board.passes(200)
                drives(board)
                how(board)
                off = board.waits(lambda status: status.resets > 0, "a reset")
                assert not off.running
                moves_nothing(board, off, 800)
                state = bus.state()
                assert (state["link"], state["mode"]) == ("up", "ready")
                (waiting,) = [source for source in state["sources"] if source["name"] == "app"]
                assert waiting["waits_for"].startswith("send a zero first")
                coasted = truly(board.is_still())
                gives_way(bus, commander)
                drives(board)
            true = truly(board.is_still())
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
        assert account(board).reset == cause


# the emergency stop


def drives_in_the_end(board: Board, bus: Bus, commander: Commander) -> None:
    """Wait until the robot drives. If a busy machine has lost the link, release the robot."""

    def look() -> bool:
        state = bus.state()
        if state["mode"] == "stopped":
            bus.get("srv/clear")
        if state["code"] == "neutral":
            gives_way(bus, commander)
        return has_speed(board.status())

    until(look, 10.0, "it drives")


@pytest.mark.parametrize(("baud", "rate"), [(115200, 100), (9600, 10)])
def test_a_press_at_the_robot_stops_it_and_clear_is_refused_until_the_release(
    runner: Path, wired: dict[int, Path], tmp_path: Path, baud: int, rate: int
) -> None:
    mcu = CHECKED if baud == 115200 else {"baud_rate": baud}
    safety, control = {"estop": "required"}, {"rate": rate}
    words = ("--baud", str(baud))
    with Board(runner, wired[baud], *words, live=True) as board:
        wire(board)
        with (
            running(board, tmp_path, mcu, safety=safety, control=control) as (_, _, bus),
            bus.commanding(0.5) as commander,
        ):
            drives_in_the_end(board, bus, commander)
            board.passes(1500)
            drives_in_the_end(board, bus, commander)
            board.command(f"contact {ESTOP} open")
            until(lambda: bus.state()["code"] == "emergency_stop", 3.0, "a stop")
            assert bus.state()["emergency_stop"] == "pressed"
            off = board.is_still()
            assert "p00.00,bp00.00,cp00.00,dp00.00" in off.to_board.last
            assert not bus.get("srv/clear")["success"]
            moves_nothing(board, off, 600)
            board.command(f"contact {ESTOP} closed")
            until(lambda: bus.state()["emergency_stop"] == "released", 3.0, "the release")
            moves_nothing(board, off, 600)
            assert bus.get("srv/clear")["success"]
            moves_nothing(board, off, 300)
            drives_in_the_end(board, bus, commander)
            board.command(f"contact {BUMPERS[1]} open")
            board.passes(1500)
            rows = bus.get("diagnostics")["status"]
            (row,) = [entry for entry in rows if entry["name"].endswith("board")]
            counters = bus.state()["counters"]
        values = {entry["key"]: entry["value"] for entry in row["values"]}
        print(f"\n{baud} baud, {rate} Hz: {values}")
        assert (values["bumpers"], values["motor_driver"]) == (".X..", "ok")
        assert float(values["volts"]) == pytest.approx(24.0, abs=0.1)
        assert float(values["amperes"]) == pytest.approx(0.0, abs=0.2)
        assert counters["emergency_stops"] == 1 or board.status().skipped_ns > 0, counters
        assert not any(name.startswith("line_status") for name in counters), counters


# the wire


def test_a_lost_link_is_restored_and_the_commander_must_be_neutral_first(
    board: Board, tmp_path: Path
) -> None:
    """First the board falls silent, then its plug is pulled. The commander sends all the time.

    The daemon restores the link, and the robot does not move until the commander sends zeros.
    """
    port = tmp_path / "mcu"
    port.symlink_to(board.path)
    with (
        running(board, tmp_path, CHECKED, port) as (_, daemon, bus),
        bus.commanding(0.5) as commander,
        bus.follow("state") as states,
    ):

        def link(word: str, since: float) -> float:
            """Wait until `state` reports this link. Return the time since `since` in ms."""
            event = states.find(lambda state: state["link"] == word, 3.0, word, after=since)
            return 1000 * (event.at - since)

        drives(board)
        at = time.monotonic()
        board.command("mute")
        stale = link("stale", at)
        off = board.is_still()
        stopped = (off.wanted_ns + off.base_ns) / MS - at * 1000
        # After less than a second it would ramp up again by itself.
        board.passes(1200)
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
        off = board.waits(lambda status: not status.running, "motors off")
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


def test_on_a_bad_wire_the_robot_drives_on_without_a_wrong_speed_or_a_lost_distance(
    board: Board, tmp_path: Path
) -> None:
    """A tenth of the lines to the board is damaged or cut, and a third of its replies or lost."""
    with running(board, tmp_path, CHECKED) as (_, daemon, bus):
        with bus.follow("odom") as odom, bus.follow("wheel_states") as wheels:
            with bus.commanding(0.0) as commander:
                for fault in ("noise to 503", "drop to 1009", "noise from 307", "lose from 15"):
                    board.command(fault)
                ended = drive_about(board, commander, 5.0)
                for way in ("noise to 0", "drop to 0", "noise from 0", "lose from 0"):
                    board.command(way)
            off_by = errors(odom, wheels, ended)
        stale, modes = len(daemon.events("link_stale")), bus.at_rest()["mode"]
    print(f"\n{ended.to_board.damaged + ended.to_board.lost} bytes to the board lost or damaged, "
          f"{ended.from_board.lost / ended.from_board.bytes:.0%} of its replies lost; {off_by}; "
          f"link stale {stale} times")  # fmt: skip
    assert (ended.wrong, modes) == (0, "ready")
    assert ended.to_board.damaged > 20
    assert ended.from_board.lost > 0.1 * ended.from_board.bytes
    assert off_by.worst < 0.001
    assert account(board).trips == 0
