"""The legs and the questions of a guided drive, and the sentences of a result, are approved texts.

A person drives and decides by them, so a change of a number in them must be read.
"""

from __future__ import annotations

import difflib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from rich.console import Console

from acsard.calibration import result as results
from acsard.calibration.comparison import Match
from acsard.calibration.fit import Errors, Fit, fit
from acsard.calibration.guide import guided
from acsard.calibration.log import Log, LogError, Run
from acsard.calibration.noise import Noise
from acsard.calibration.plan import METHODS, Setup, legs
from acsard.calibration.result import calibrate, text
from acsard.calibration.series import Floats
from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config
from acsard.terminal.prompt import NumberQuestion
from tests.unit.test_calibration_guide import SETUP, Robot
from tests.unit.test_calibration_matches import log

WORDS = Path(__file__).with_name("words")
Approved = Callable[[Path, str], None]
ROBOTS = {
    "usual": "",
    "small and slow": "[drive]\nwheel_separation = 0.1\nwheel_radius = 0.02\n"
    "[limits]\nwheel_speed = 4.0\nlinear_deceleration = 0.2\n",
    "large": "[drive]\nwheel_separation = 0.9\nwheel_separation_multiplier = 1.6\n"
    "left_wheel_radius_multiplier = 1.02\n[limits]\nangular_speed = 0.9\n",
}


def plans() -> Iterator[str]:
    for name, config in ROBOTS.items():
        setup = Setup.of(parse(config.encode()))
        for method in METHODS:
            for track in (1.0, 1.6) if method == "tape" else (1.0,):
                yield f"== {name}, {method}, track {track}"
                for leg in legs(method, setup, track):
                    yield f"{leg.name}: {leg.words}"
                    yield from (
                        f"  {move.seconds:.3f} s, {move.linear:.4f} m/s, {move.angular:.4f} rad/s"
                        for move in leg.moves
                    )
                    yield f"  {leg.seconds:.3f} s, {leg.whole_turns:.4f} rad, {leg.by_key}"
                    yield from (
                        f"  {ask.name}: {ask.words} {ask.unit} {ask.least} {ask.most} {ask.usual}"
                        for ask in leg.asks
                    )


def test_the_legs_have_the_approved_moves(approved: Approved) -> None:
    approved(WORDS / "calibration_legs.txt", "\n".join([*plans(), ""]))


class Person(Robot):
    """A person who takes back only what is not true. Every question and answer is noted."""

    def start(self, text: str) -> None:
        self.said.append(f"[starts] {text}")

    def instruct(self, text: str) -> None:
        self.said.append(f"[reads] {text}")

    def ask(self, question: str, answers: Sequence[str]) -> str:
        answer, self.confirms = super().ask(question, answers), "yes"
        self.said.append(f"[answers] {answer}")
        return answer

    def number(self, ask: NumberQuestion) -> float:
        if self.lies.get(ask.name):
            self.confirms = "no"
        value = super().number(ask)
        self.said.append(f"[answers {ask.name}] {value:.0f} {ask.unit}")
        return value


def conversations() -> Iterator[str]:
    lies = {
        "": {},
        "distances that are right to 15 %": {"distance": [1700.0]},
        "a distance that is not": {"distance": [1610.0]},
        "a distance that is short": {"distance": [450.0]},
        "a robot at 29 deg": {"front": [389.0], "rear": [510.0]},
        "a robot at 31 deg": {"front": [386.0], "rear": [515.0]},
        "a robot at 80 deg": {"front": [100.0], "rear": [344.0]},
    }
    for method, kind in [("gyro", ""), *(("tape", kind) for kind in lies)]:
        person = Person(1.5)
        person.method, person.confirms = method, "yes"
        person.lies = {name: [*values] for name, values in lies[kind].items()}
        person.disturbed = [LogError("a chair")] * (kind == "")
        runs = guided(method, SETUP, person, person.ride).runs
        yield f"== {method}, {kind or 'honest answers'}"
        yield from person.said if not kind else person.said[:9]
        for run in runs:
            tapes = (f"{r.quantity} {r.value:.4f} +- {r.std:.5f}" for r in run.tape)
            yield f"{run.name}, {run.seconds:.1f} s: {', '.join(tapes)}"


def test_a_guided_drive_has_the_approved_words(approved: Approved) -> None:
    approved(WORDS / "calibration_guide.txt", "\n".join([*conversations(), ""]))


QUIET = Noise(None, None, 1e-6, 1e-6, None, 1e-6, False, False)
SHOWN = Noise(2e-4, 3e-4, 4e-4, 9e-6, 5e-5, 1.6e-5, True, True)


class Said:
    """What a calibration says if its parts find this."""

    def __init__(self, patch: pytest.MonkeyPatch, run: Run, found: Fit) -> None:
        self._patch, self.run, self.found = patch, run, found

    def __call__(
        self, config: Config | None = None, noise: Noise = QUIET, response: float | None = None,
        names: tuple[str, ...] = ("gyro",), others: Mapping[tuple[str, ...], Fit] = {},
        **changes: object,
    ) -> str:  # fmt: skip
        found = structs.replace(self.found, **changes)
        matches = {name: Match(name, 0.02, 1.5, 0.0, 0.02) for name in names}
        patch = self._patch.setattr
        patch(results, "examined", lambda runs, drive: ([self.run], matches, ["a sensor's note"]))
        patch(results, "fit", lambda runs, config, m: others.get(tuple(m), found))
        patch(results, "noise", lambda *_: noise)
        patch(results, "response_time", lambda *_: response)
        config = config or Config()
        try:
            made = calibrate(Log((self.run,), ("a note",)), config, "a.csv")
        except LogError as error:
            return "\n".join(["refused:", str(error), *getattr(error, "__notes__", ())])
        console = Console(file=io.StringIO(), width=110)
        for part in text(made, config, "acsard.toml"):
            console.print(part, markup=False, highlight=False, soft_wrap=True)
        assert isinstance(console.file, io.StringIO)
        return "\n".join(line.rstrip() for line in console.file.getvalue().splitlines())


def test_of_many_runs_at_most_forty_show_whether_two_sensors_agree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, counts = log("gyro"), list[int]()
    found = fit([run], Config())
    matches = {name: Match(name, 0.02, 1.5, 0.0, 0.02) for name in ("gyro", "positions")}
    monkeypatch.setattr(results, "noise", lambda *_: QUIET)

    def count(runs: Sequence[Run], config: Config, matches: Mapping[str, Match]) -> Fit:
        counts.append(len(runs))
        return found

    monkeypatch.setattr(results, "fit", count)
    for number in (1, 39, 79, 80, 130):
        runs = [run] * number
        monkeypatch.setattr(
            results, "examined", lambda _, drive, runs=runs: (runs, matches, list[str]())
        )
        counts.clear()
        calibrate(Log(tuple(runs[:1]), ()), Config(), "a.csv")
        *alone, together = counts
        assert together == number
        assert len(alone) == 2
        assert all(min(number, 20) <= some <= 40 for some in alone)


def moved(found: Fit, left: float, right: float, track: float) -> Floats:
    return np.concatenate(([left, right, track], found.p[3:]))


def test_a_result_has_the_approved_words(
    approved: Approved, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = log("gyro")
    found = structs.replace(
        fit([run], Config()), covariance=np.diag([1e-4, 1e-4, 4e-4]), gyro_std=0.03, gain=2.0,
        gain_std=0.1, worst=1.0, turn=Errors(1.2, 0.0123), halves=0.0,
    )  # fmt: skip
    found = structs.replace(found, p=moved(found, -0.004, 0.006, 0.4))
    far, near = moved(found, 0.0, 0.0, 0.05), moved(found, 0.0, 0.0, 0.03)
    other = parse(b"[drive]\nwheel_separation_multiplier = 1.2\n[feedback]\nresponse_time = 0.3\n")
    say = Said(monkeypatch, run, found)
    place = Errors(0.123, 0.0098)
    sized: dict[str, Any] = {
        "sized": True,
        "place": place,
        "sensors": ("gyro", "positions"),
        "gyro_std": 0.0,
    }
    worse: dict[str, Any] = {"gain": -1.0, "worst": -1.0}
    both = ("gyro", "positions")
    gyro = structs.replace(found, gyro_std=0.01)
    vague = structs.replace(found, gain=-1.0, covariance=100 * found.covariance)
    sure = structs.replace(found, gain=-1.0, covariance=0.01 * found.covariance, gyro_std=0.0)
    less = structs.replace(vague, p=moved(found, 0.0, 0.0, 0.3))
    farther = structs.replace(found, gain=-1.0, gyro_std=0.06, p=moved(found, 0.0, 0.0, 0.29))
    exact = [
        structs.replace(
            found, gyro_std=0.0, covariance=1e-8 * np.eye(3), p=moved(found, 0, 0, track)
        )
        for track in (0.3, 0.395, 0.405)
    ]
    rival = structs.replace(gyro, p=moved(found, 0.0, 0.0, 0.55))
    agrees = structs.replace(gyro, p=moved(found, 0.0, 0.0, 0.31))
    cases = {
        "a gyro alone": say(),
        "another configuration": say(other, response=0.44),
        "a response that is longer": say(other, response=0.456),
        "the noise, by a gyro": say(noise=SHOWN),
        "the noise, by both": say(noise=SHOWN, **sized),
        "the noise of the heading alone": say(noise=structs.replace(SHOWN, distance_better=False)),
        "a heading without noise": say(
            noise=structs.replace(
                SHOWN, yaw_per_metre=None, yaw_per_radian=None, track=0.0, ratio=0.0
            )
        ),
        "a distance without noise": say(
            noise=structs.replace(SHOWN, distance_per_metre=None, scale=0.0, heading_better=False)
        ),
        "halves": say(halves=0.123),
        "too few values": say(names=both, others={("gyro",): gyro, ("positions",): gyro}),
        "exact turns": say(turn=Errors(1.2, 0.0018)),
        "turns that are not exact": say(turn=Errors(1.2, 0.0020)),
        "exact positions": say(**sized | {"place": Errors(0.1, 0.00029)}),
        "positions that are not exact": say(**sized | {"place": Errors(0.1, 0.00031)}),
        "far from the configuration, but not better": say(p=far, **worse),
        "near the configuration": say(p=near, **worse),
        "1 % beside the configuration": say(
            p=moved(found, 0.0, 0.0, 0.0099), covariance=1e-8 * np.eye(3), **worse
        ),
        "more than 1 % beside it": say(
            p=moved(found, 0.0, 0.0, 0.0101), covariance=1e-8 * np.eye(3), **worse
        ),
        "near the configuration, but exact": say(p=near, turn=Errors(0.001, 0.001), **worse),
        "near the configuration, with a response": say(p=near, response=2.0, **worse),
        "no track": say(tracked=False),
        "two tracks": say(names=both, others={("gyro",): gyro, ("positions",): rival}),
        "two tracks, the other way": say(
            names=both, others={("gyro",): rival, ("positions",): gyro}
        ),
        "sure tracks that differ by 10.5 %": say(
            names=both, others={("gyro",): exact[0], ("positions",): exact[2]}
        ),
        "sure tracks that differ by 9.5 %": say(
            names=both, others={("gyro",): exact[0], ("positions",): exact[1]}
        ),
        "two tracks that agree": say(names=both, others={("gyro",): gyro, ("positions",): agrees}),
        "two tracks of which one is not shown": say(
            names=both,
            others={("gyro",): gyro, ("positions",): structs.replace(rival, tracked=False)},
        ),
        "a sensor by which no value is better": say(
            names=both, others={("gyro",): gyro, ("positions",): vague}, p=far, **worse
        ),
        "one that knows more": say(
            names=both, others={("gyro",): gyro, ("positions",): sure}, p=far, **worse
        ),
        "one that is not so far": say(
            names=both, others={("gyro",): gyro, ("positions",): less}, p=far, **worse
        ),
        "one that is farther than its deviation": say(
            names=both, others={("gyro",): gyro, ("positions",): farther}, p=far, **worse
        ),
        "one that is farther, but shows no track": say(
            names=both,
            others={("gyro",): gyro, ("positions",): structs.replace(farther, tracked=False)},
            p=far, **worse,
        ),
        "none by which values are better": say(
            names=both, others={("gyro",): vague, ("positions",): vague}, p=far, **worse
        ),
    }  # fmt: skip
    usual = cases["a gyro alone"].splitlines()
    lines: list[str] = []
    for name, words in cases.items():
        said = words.splitlines()
        if lines and words.startswith("a.csv"):  # only what the first case does not say
            said = [
                line for line in list(difflib.unified_diff(usual, said, n=0, lineterm=""))[2:]
                if not line.startswith("@@")
            ]  # fmt: skip
        lines += [f"== {name}", *said, ""]
    approved(WORDS / "calibration_results.txt", "\n".join(lines))
