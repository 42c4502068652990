"""Tests of the check of inputs: the operator presses each input, and the board reports it."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from acsard.checkup import inputs
from acsard.checkup.findings import Finding
from acsard.core.config.settings import Config, Place, SafetyConfig
from tests.unit.checkup.robots import Nobody, Person, Robot

TWO: tuple[Place, ...] = ("front", "rear")


def checked(
    *faults: str,
    presses: Mapping[str, int] | None = None,
    safety: SafetyConfig = SafetyConfig(),  # noqa: B008
    reports: int = 2,
) -> tuple[Finding, list[str]]:
    """Return the finding for a board with this number of bumpers, and the texts on the screen.

    `presses` maps the name of an input to the input that the person really presses. 0 is the
    emergency stop.
    """
    front: Place = "front"
    places = (front,) * reports
    robot = Robot(*faults, config=Config(safety=SafetyConfig(bumpers=places)))
    texts: list[str] = []

    class Watched(Person):
        def doing(self, text: str) -> None:
            texts.append(text)
            super().doing(text)

    operator = Nobody() if presses is None else Watched(robot)
    if presses is not None and isinstance(operator, Person):
        operator.presses = dict(presses)
    with robot.board() as board:
        board.listen(0.5)
        return inputs.finding(board, operator, safety), texts


ALL = {"emergency stop": 0, "front bumper": 1, "rear bumper": 2}
SAFETY = SafetyConfig(estop="required", bumpers=TWO)


def test_a_board_without_inputs_has_nothing_to_press() -> None:
    finding, _ = checked(presses={})
    assert (finding.verdict, finding.text) == (
        "SKIPPED", "no emergency stop and no bumpers are reported or configured",
    )  # fmt: skip


def test_each_input_is_pressed_in_turn_and_passes() -> None:
    finding, texts = checked("estop", "bumpers", presses=ALL, safety=SAFETY)
    assert (finding.verdict, finding.figure) == (
        "PASS",
        "emergency stop, front bumper, rear bumper",
    )
    assert texts == [f"press the {name} and release it, within 20 s" for name in ALL]


def test_an_emergency_stop_that_is_reported_but_not_configured_is_pressed_too() -> None:
    assert checked("estop", presses=ALL)[0].figure == "emergency stop"
    off = SafetyConfig(estop="off", bumpers=TWO, bumper="off")
    assert checked("estop", "bumpers", presses=ALL, safety=off)[0].verdict == "SKIPPED"


def test_bumpers_that_are_reported_but_not_configured_are_pressed_by_number() -> None:
    presses = {"bumper 1": 1, "bumper 2": 2}
    assert checked("bumpers", presses=presses)[0].figure == "bumper 1, bumper 2"
    finding, _ = checked("bumpers", presses={"bumper 1": 2, "bumper 2": 2})
    assert (
        finding.text == "bumper 1: no press was reported; instead the board reported the bumper 2"
    )


def test_without_a_person_the_check_names_what_it_did_not_check() -> None:
    finding, _ = checked("estop", "bumpers", safety=SAFETY)
    assert (finding.verdict, finding.figure) == ("SKIPPED", "not checked")
    assert finding.text.endswith(": emergency stop, front bumper, rear bumper")


@pytest.mark.parametrize(
    ("faults", "reports"), [(("estop",), 2), (("bumpers",), 2), (("estop", "bumpers"), 3)]
)
def test_a_configured_input_that_is_not_reported_fails(
    faults: tuple[str, ...], reports: int
) -> None:
    finding, texts = checked(*faults, presses=ALL, safety=SAFETY, reports=reports)
    assert (finding.verdict, finding.figure, texts) == ("FAIL", "not reported", [])
    assert "`!status estop=ok bumpers=..`" in finding.mend


@pytest.mark.parametrize(
    ("presses", "text"),
    [
        ({"front bumper": 2, "rear bumper": 1},
         "front bumper: no press was reported; instead the board reported the rear bumper; "
         "rear bumper: no press was reported; instead the board reported the front bumper"),
        ({"front bumper": 1}, "rear bumper: no press was reported"),
    ],
)  # fmt: skip
def test_swapped_and_dead_inputs_are_named(presses: Mapping[str, int], text: str) -> None:
    safety = SafetyConfig(bumpers=TWO)
    finding, _ = checked("bumpers", presses=presses, safety=safety)
    assert (finding.verdict, finding.text) == ("FAIL", text)


def test_an_input_that_stays_pressed_or_also_reports_another_input_is_named() -> None:
    safety, presses = SafetyConfig(bumpers=TWO), {"front bumper": 1, "rear bumper": 2}
    finding, _ = checked("bumper_pressed=2:0:0", presses=presses, safety=safety)
    assert finding.text == (
        "front bumper: the board also reported the rear bumper; "
        "rear bumper: no release was reported"
    )
    assert finding.figure == "0 of 2 right"


def test_two_bumpers_at_one_place_have_numbers() -> None:
    safety = SafetyConfig(bumpers=("front", "front"))
    presses = {"front bumper (1)": 1, "front bumper (2)": 2}
    finding, _ = checked("bumpers", presses=presses, safety=safety)
    assert (finding.verdict, finding.figure) == ("PASS", "front bumper (1), front bumper (2)")
