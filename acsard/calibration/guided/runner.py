"""Leads a person through a way of calibration, leg by leg, to the result."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from acsard.calibration.guided.legs import UNITS, Leg, Setup
from acsard.calibration.guided.measured import calibrated
from acsard.calibration.guided.needs import NEEDS
from acsard.calibration.guided.readings import Answers, Reading, effective, reading
from acsard.calibration.guided.ways import STRAIGHT, WAYS
from acsard.calibration.runs import Log, Run
from acsard.calibration.solve import Calibration, calibrate
from acsard.calibration.tape_distance import LEAST_M, Tape
from acsard.terminal.prompt import Ask, Prompt


def guide(name: str, setup: Setup, prompt: Prompt, ride: Callable[[Leg], Run]) -> Calibration:
    """Lead a person through the way of calibration of this name, and return the result.

    `ride` drives one leg and returns its recording. Raises `GuideError`, `LogError`,
    `NobodyError` and `RefusedError`.
    """
    way = WAYS[name]
    prompt.say(
        f"Calibration with {NEEDS[name]}. The robot drives for at most {way.longest_s(setup):.0f} "
        "s in all. Stay near the robot: any key stops it at once."
    )
    rides: dict[str, Run] = {}
    answers: Answers = {}
    readings: list[Reading] = []
    # The legs that depend on the track follow the reading that tells it.
    track, number = 1.0, 0

    def ask_for(leg: str, asks: tuple[Ask, ...]) -> None:
        for ask in asks:
            answers[leg, ask.name] = UNITS[ask.unit] * prompt.number(ask)

    ask_for("", way.asks)
    while number < len(legs := way.legs(setup, track)):
        leg, number = legs[number], number + 1
        prompt.start(f"{number}. {leg.words} ({leg.seconds:.0f} s)", leg.by_key)
        rides[leg.name] = ride(leg)
        ask_for(leg.name, leg.asks)
        for measure in leg.measures:
            readings.append(reading(measure, leg.name, rides, answers))
            if measure.what == "turned":
                track = effective(readings[-1], setup.drive)
    if way.tool:
        return calibrated(way.tool, readings, setup.drive)
    metres = answers.get((STRAIGHT, "metres"), 0.0)
    tape = Tape(metres, STRAIGHT) if metres >= LEAST_M else None
    log = Log(tuple(replace(run, name=name) for name, run in rides.items()), ())
    return calibrate(log, setup.drive, tape)
