"""Leads a person through a method of calibration, leg by leg, and computes the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from msgspec.structs import replace

from acsard.calibration.guided.drive_plan import (
    NEEDS,
    UNITS,
    DisturbedError,
    Leg,
    Setup,
    Slant,
)  # fmt: skip
from acsard.calibration.guided.methods import METHODS, STRAIGHT_LEG
from acsard.calibration.guided.tape_readings import (
    Answers,
    Reading,
    calibrated,
    reading,
    track_ratio,
)  # fmt: skip
from acsard.calibration.multipliers import MIN_TAPE_M, Tape
from acsard.calibration.runs import Log, Run
from acsard.calibration.solve import Calibration, calibrate
from acsard.calibration.wheel_response import response
from acsard.terminal.prompt import NumberQuestion, Prompt

MAX_REPEATS = 2
"""Maximum number of times that a disturbed leg is repeated on a real robot."""

MAX_SIMULATED_REPEATS = 20
"""Maximum number of times that a disturbed leg is repeated on the simulator.

The number is large because no person has to put the simulated robot back.
"""


def begins_again(legs: Sequence[Leg], number: int, *, sensor: bool) -> int:
    """Return the index of the leg with which the drive continues after a disturbed leg.

    If a sensor measures the motion (`sensor`), only the disturbed leg `number` is repeated.
    Otherwise a person measures by tape, relative to the place where the person put the robot before
    the first leg. The drive then returns to the first leg.

    Some legs need only the robot's angle at their start (`angle_before`). Such a leg is repeated
    alone, after the person has measured this angle again.
    """
    return number if sensor or angle_before(legs[number]) else 0


def angle_before(leg: Leg) -> str:
    """Return the name of the earlier leg after which the person measured the start angle of `leg`.

    Return "" if `leg` needs no start angle, or if its measurements cover several legs.
    """
    slants = [measure for measure in leg.measures if isinstance(measure, Slant)]
    return next((slant.since for slant in slants if slant.since and not slant.over), "")


def guide(
    name: str, setup: Setup, prompt: Prompt, ride: Callable[[Leg], Run], *,
    simulated: bool = False, true_positions: bool = False,
) -> Calibration:  # fmt: skip
    """Lead a person through the legs of a method of calibration, and return the calibration.

    Args:
        name: the name of the method, as in `METHODS`.
        setup: the robot, and the speeds and lengths of its drive.
        prompt: shows texts to the person, and asks the questions.
        ride: the function that drives one leg and returns the recording of this leg.
        simulated: whether the robot is the built-in simulator, which allows more repeats.
        true_positions: whether the recorded positions are the simulator's true ones.

    Raises:
        GuideError: the drive cannot continue.
        LogError: a recording has too few samples.
        NobodyError: no person answers the questions.
        NoCalibrationError: the measurements are impossible or contradict each other, or the drive
            gives no useful calibration.
    """
    method = METHODS[name]
    longest = method.longest_s(setup)
    prompt.show_text(
        f"Calibration with {NEEDS[name]}. The robot drives for at most {longest:.0f} s in total, "
        "in several legs. If a leg is disturbed, the drive continues with that leg or an earlier "
        "one. Stay near the robot: any key stops the robot immediately."
    )
    rides: dict[str, Run] = {}
    answers: Answers = {}
    readings: dict[str, list[Reading]] = {}
    # The legs are computed again after each leg, because a measurement may have changed `track`.
    # The legs that depend on the effective track come after the measurement that shows it.
    track, number = 1.0, 0
    repeats: dict[str, int] = {}
    most = MAX_SIMULATED_REPEATS if simulated else MAX_REPEATS

    def ask_for(leg: str, asks: tuple[NumberQuestion, ...]) -> None:
        for ask in asks:
            answers[leg, ask.name] = UNITS[ask.unit] * prompt.number(ask)

    def repeat(disturbed: DisturbedError) -> int:
        leg = legs[number]
        repeats[leg.name] = repeats.get(leg.name, 0) + 1
        if repeats[leg.name] > most:
            raise disturbed
        again = begins_again(legs, number, sensor=not method.by_tape)
        back = "" if simulated else ": put the robot back where it stood when that leg began"
        end = "" if disturbed.why.endswith("?") else "."
        prompt.show_text(
            f"Leg {number + 1} was disturbed: {disturbed.why}{end} The drive continues with leg "
            f"{again + 1}{back}."
        )
        if method.by_tape and again == number and (since := angle_before(leg)):
            (before,) = [candidate for candidate in legs if candidate.name == since]
            ask_for(since, before.asks)
        return again

    ask_for("", method.asks)
    while number < len(legs := method.legs(setup, track)):
        leg = legs[number]
        prompt.start(f"{number + 1}. {leg.words} ({leg.seconds:.0f} s)")
        try:
            rides[leg.name] = ride(leg)
        except DisturbedError as error:
            number = repeat(error)
            continue
        number += 1
        ask_for(leg.name, leg.asks)
        readings[leg.name] = []
        for measure in leg.measures:
            made = reading(measure, leg.name, rides, answers)
            readings[leg.name].append(made)
            if made.quantity == "turned":
                track = track_ratio(made, setup.drive)
    if method.by_tape:
        all_readings = [made for leg in legs for made in readings[leg.name]]
        result = calibrated(all_readings, setup.drive, setup.odometry)
        follows = response(list(rides.values()), setup.drive, setup.feedback)
        if follows is None:
            return result
        notes = (*follows.sentences(), *result.notes)
        return replace(result, notes=notes, feedback=follows.settings())
    metres = answers.get((STRAIGHT_LEG, "metres"), 0.0)
    tape = Tape(metres, STRAIGHT_LEG) if metres >= MIN_TAPE_M else None
    driven = tuple(replace(run, name=name) for name, run in rides.items())
    log = Log(driven, (), true_positions)
    return calibrate(log, setup.drive, tape, setup.odometry, setup.feedback)
