"""Asks the operator to press the emergency stop and each bumper, and checks the board's reports.

The emergency stop and the bumpers are called the inputs of the board. The board reports them in
status lines (`core/link/board_status.py`). This step is the last step of the check, because the
emergency stop switches the motors off, and some motor drivers must be enabled again afterward.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.checkup import outcomes
from acsard.checkup.board import Board, Operator
from acsard.checkup.findings import Finding
from acsard.core.config.settings import SafetyConfig

PRESS_TIMEOUT_S = 20.0
"""Time within which the operator must press and release the emergency stop or a bumper, s."""

REPORT_TIMEOUT_S = 0.5
"""Time within which every board reports its emergency stop and each bumper at least once, s."""


class Input(Struct, frozen=True):
    """The emergency stop or one bumper of the board."""

    number: int
    """0 for the emergency stop, or 1, 2, ... for a bumper, in the order of the status line."""
    name: str


def finding(board: Board, operator: Operator, safety: SafetyConfig) -> Finding:
    """Let the operator press each input, and check that the board reports each press and release.

    The inputs are the emergency stop and the bumpers that the configuration requires or that the
    board reports. A bumper is named by its configured place on the robot, or by its number if the
    configuration contains no places. The inputs are not tested if no operator is ready.
    """
    board.send_zero(REPORT_TIMEOUT_S)
    estop = safety.estop == "required" or (safety.estop == "auto" and 0 in board.inputs)
    places = () if safety.bumper == "off" else safety.bumpers
    counted = 0 if safety.bumper == "off" else sum(number > 0 for number in board.inputs)
    names = [f"{place} bumper" for place in places]
    names = names or [f"bumper {number}" for number in range(1, counted + 1)]
    # Two bumpers can have the same place. Then their names also contain their numbers.
    same = [names.count(name) > 1 for name in names]
    inputs = [Input(0, "emergency stop")] if estop else []
    inputs += [
        Input(i + 1, f"{name} ({i + 1})" if same[i] else name) for i, name in enumerate(names)
    ]
    if not inputs:
        return outcomes.find("inputs: none")
    listed = ", ".join(each.name for each in inputs)
    if (estop and 0 not in board.inputs) or (places and counted != len(places)):
        fields = [*["estop=ok"] * estop, *["bumpers=" + "." * len(places)] * bool(places)]
        return outcomes.find("inputs: missing", listed=listed, fields=" ".join(fields))
    question = (
        f"The board has these inputs: {listed}. You will press and release each of them once. Type "
        '"ready" when you stand at the robot, or "skip":'
    )
    if operator.ask(question, ("ready", "skip")) != "ready":
        return outcomes.find("inputs: not pressed", listed=listed)
    wrong = [text for each in inputs if (text := _pressed(board, operator, each, inputs))]
    if wrong:
        right = f"{len(inputs) - len(wrong)} of {len(inputs)} right"
        return outcomes.find("inputs: wrong", figure=right, wrong="; ".join(wrong))
    return outcomes.find("inputs: right", listed=listed)


def _pressed(board: Board, operator: Operator, asked: Input, inputs: list[Input]) -> str:
    operator.doing(f"press the {asked.name} and release it, within {PRESS_TIMEOUT_S:g} s")
    end_s, numbers = board.now_s + PRESS_TIMEOUT_S, set[int]()
    while board.now_s < end_s:
        board.send_zero()
        now = {number for number, pressed in board.inputs.items() if pressed}
        numbers |= now
        if numbers and not now:
            break
    others = [each.name for each in inputs if each.number in numbers - {asked.number}]
    if asked.number not in numbers:
        instead = f"; instead the board reported the {' and the '.join(others)}" if others else ""
        return f"{asked.name}: no press was reported{instead}"
    if others:
        return f"{asked.name}: the board also reported the {' and the '.join(others)}"
    return "" if not now else f"{asked.name}: no release was reported"
