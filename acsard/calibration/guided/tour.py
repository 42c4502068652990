"""Calibration with a gyro or with positions: legs that go there and back, whatever the track is."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.calibration.guided.legs import ROOM, Leg, Move, Setup, Way, ask, ride
from acsard.calibration.runs import Log, Run
from acsard.calibration.solve import calibrate
from acsard.calibration.tape_distance import LEAST_M, Tape

FAST, SLOW, CURVE = 1.5, 0.75, 0.8
"""Rates of turns and curves as they would be without skidding, rad/s."""

SPIN_S = 7.5
CURVE_M = 1.2

TURN_RAD = 5.0
PETALS = ((FAST, CURVE), (-FAST, -CURVE), (SLOW, 0.0), (-SLOW, CURVE), (FAST, -CURVE))
"""Rates of each turn on the spot and of the curve after it, rad/s, without skidding."""

STANDING_S, PAUSE_S, SHORT_S = 2.5, 1.4, 0.7
"""Pauses in s: at first, in between, and where the robot only has to stop.

The gyro bias is measured in the longer ones.
"""

STRAIGHT = "straight"
"""Name of the run that the tape measures."""

REST = Move(PAUSE_S)


def straight(setup: Setup) -> Leg:
    """Return the first leg, along a straight line."""
    return Leg(
        f"Set the robot {setup.from_edge:.2f} m (its middle) from the near edge of a free floor of "
        f"{ROOM:g} m x {ROOM:g} m, {ROOM / 2:g} m from both sides, looking to the far edge. Mark "
        "on the floor where one of its wheels stands. Do not move it by hand until all is done. It "
        f"stands for {STANDING_S:g} s, then drives {setup.length:.2f} m straight ahead.",
        (Move(STANDING_S), setup.ahead(setup.length), Move(PAUSE_S)),
    )


def spins(setup: Setup) -> Leg:
    """Return turns and curves about the middle, for a gyro."""
    curve = _curve(setup)
    moves = [REST, setup.ahead(-setup.to_middle), REST]
    for rate in (FAST, -FAST, SLOW, -SLOW):
        moves += [setup.spin(rate, SPIN_S), REST]
    for rate in (CURVE, -CURVE, 0.0):
        moves += _there_and_back(setup, rate, curve)
    return Leg(
        "It drives back to the middle, turns on the spot to both sides, fast and slowly, and "
        "drives three curves there and back.",
        (*moves, REST),
    )


def petals(setup: Setup) -> Leg:
    """Return turns and curves from the middle, for positions.

    Positions show a turn on the spot only by the curve that follows it.
    """
    curve = _curve(setup)
    moves = [Move(SHORT_S), setup.ahead(-setup.to_middle), Move(SHORT_S)]
    for rate, bend in PETALS:
        moves += [setup.spin(rate, TURN_RAD / abs(rate)), Move(SHORT_S)]
        moves += _there_and_back(setup, bend, curve)
    return Leg(
        "It drives back to the middle; then, again and again, it turns a part on the spot and "
        "drives a curve there and back.",
        tuple(moves),
    )


def _curve(setup: Setup) -> float:
    """Return the length of a curve from the middle that stays on the floor in any direction, m."""
    return min(CURVE_M, ROOM / 2 - setup.from_edge)


def _there_and_back(setup: Setup, rate: float, metres: float) -> list[Move]:
    return [
        setup.arc(rate, metres), Move(SHORT_S), setup.arc(-rate, -metres), Move(SHORT_S),
    ]  # fmt: skip


def spinning_s(setup: Setup, track: float) -> float:
    """Return the driving time with a gyro, s. It does not depend on the effective track."""
    return straight(setup).seconds + spins(setup).seconds


def petals_s(setup: Setup, track: float) -> float:
    """Return the driving time with positions, s. It does not depend on the effective track."""
    return straight(setup).seconds + petals(setup).seconds


def gyro(setup: Setup) -> Way:
    """Calibrate with a gyro for turns and a tape for the distance."""
    first = yield from ride(straight(setup))
    metres = yield from ask(
        "How far is that wheel from its mark now, in a straight line? Enter alone: not measured",
        "m", 0.0, 2 * setup.length, 0.0,
    )  # fmt: skip
    turns = yield from ride(spins(setup))
    tape = Tape(metres, STRAIGHT) if metres >= LEAST_M else None
    return calibrate(_log(first, turns), setup.drive, tape)


def positions(setup: Setup) -> Way:
    """Calibrate with positions of any source."""
    first = yield from ride(straight(setup))
    turns = yield from ride(petals(setup))
    return calibrate(_log(first, turns), setup.drive)


def _log(first: Run, turns: Run) -> Log:
    return Log((replace(first, name=STRAIGHT), replace(turns, name="turns")), ())
