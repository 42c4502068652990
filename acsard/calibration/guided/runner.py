"""Leads a person through a method of calibration, leg by leg, and computes the result."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from acsard.calibration.guided.drive_plan import UNITS, Leg, Setup
from acsard.calibration.guided.equipment import NEEDS
from acsard.calibration.guided.methods import METHODS, STRAIGHT
from acsard.calibration.guided.tape_calibration import calibrated
from acsard.calibration.guided.tape_readings import Answers, Reading, reading, track_ratio
from acsard.calibration.runs import Log, Run
from acsard.calibration.solve import Calibration, calibrate
from acsard.calibration.tape_distance import LEAST_M, Tape
from acsard.terminal.prompt import Ask, Prompt


def guide(name: str, setup: Setup, prompt: Prompt, ride: Callable[[Leg], Run]) -> Calibration:
    """Lead a person through a method of calibration, and return the result.

    Args:
        name: the name of the method, a key of `METHODS`.
        setup: the robot and the speeds and lengths of its drive.
        prompt: asks the person.
        ride: drives one leg and returns its recording.

    Raises:
        GuideError: the drive cannot continue.
        LogError: a recording has too few samples.
        NobodyError: nobody answers the questions.
        RefusedError: the measurements are impossible or contradict each other.
    """
    method = METHODS[name]
    longest = method.longest_s(setup)
    prompt.say(
        f"Calibration with {NEEDS[name]}. The robot drives for at most {longest:.0f} "
        "s in all. Stay near the robot: any key stops it at once."
    )
    rides: dict[str, Run] = {}
    answers: Answers = {}
    readings: list[Reading] = []
    # The legs are computed again after each leg: those that depend on the effective track come
    # after the measurement that shows it.
    track, number = 1.0, 0

    def ask_for(leg: str, asks: tuple[Ask, ...]) -> None:
        for ask in asks:
            answers[leg, ask.name] = UNITS[ask.unit] * prompt.number(ask)

    ask_for("", method.asks)
    while number < len(legs := method.legs(setup, track)):
        leg, number = legs[number], number + 1
        prompt.start(f"{number}. {leg.words} ({leg.seconds:.0f} s)", leg.by_key)
        rides[leg.name] = ride(leg)
        ask_for(leg.name, leg.asks)
        for measure in leg.measures:
            readings.append(reading(measure, leg.name, rides, answers))
            if measure.quantity == "turned":
                track = track_ratio(readings[-1], setup.drive)
    if method.tool:
        return calibrated(method.tool, readings, setup.drive)
    metres = answers.get((STRAIGHT, "metres"), 0.0)
    tape = Tape(metres, STRAIGHT) if metres >= LEAST_M else None
    log = Log(tuple(replace(run, name=name) for name, run in rides.items()), ())
    return calibrate(log, setup.drive, tape)
