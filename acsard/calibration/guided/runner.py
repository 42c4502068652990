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

MAX_REPEATS = 2  # of a disturbed leg on a real robot

MAX_SIMULATED_REPEATS = 20  # no person has to put the simulated robot back


def begins_again(legs: Sequence[Leg], number: int, *, sensor: bool) -> int:
    """Return the index of the leg with which the drive continues after the disturbed leg `number`.

    If a sensor measures, only this leg is repeated. Measurements by tape are relative to the place
    where the person put the robot, so the drive returns to the first leg, unless the leg needs only
    an angle that the person measures again.
    """
    return number if sensor or angle_before(legs[number]) else 0


def angle_before(leg: Leg) -> str:
    """Return the earlier leg after which the person measured the start angle of `leg`, or ""."""
    slants = [measure for measure in leg.measures if isinstance(measure, Slant)]
    return next((slant.since for slant in slants if slant.since and not slant.over), "")


def guide(
    name: str, setup: Setup, prompt: Prompt, ride: Callable[[Leg], Run], *,
    simulated: bool = False, true_positions: bool = False,
) -> Calibration:  # fmt: skip
    """Lead a person through the legs of the method `name`, and return the calibration.

    `ride` drives a leg and returns its recording. `true_positions` are the simulator's. Raises
    `GuideError` if the drive cannot continue, `NobodyError` if no person answers, and `LogError` or
    `NoCalibrationError` if recordings or measurements give no calibration.
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
    # The legs that depend on the track come after the measurement that shows it.
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
        result = calibrated(all_readings, setup.drive)
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
