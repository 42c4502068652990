"""Asks the operator to press the emergency stop and each bumper, and checks the board's reports.

This step is the last one, because the emergency stop switches the motors off, and some motor
drivers must be enabled again afterward.
"""

from __future__ import annotations

from acsard.checkup import outcomes
from acsard.checkup.board import Board, Operator
from acsard.checkup.findings import Finding
from acsard.core.config.settings import SafetyConfig

# Time within which the operator must press and release the emergency stop or a bumper.
PRESS_TIMEOUT_S = 20.0

# Time within which every board reports its emergency stop and each bumper at least once.
REPORT_TIMEOUT_S = 0.5


def finding(board: Board, operator: Operator, safety: SafetyConfig) -> Finding:
    """Let the operator press each input that is configured or that the board reports.

    The inputs are the emergency stop and the bumpers. They are not tested if no operator is ready.
    """
    board.send_zero(REPORT_TIMEOUT_S)
    estop = safety.estop == "required" or (safety.estop == "auto" and 0 in board.inputs)
    places = () if safety.bumper == "off" else safety.bumpers
    counted = 0 if safety.bumper == "off" else sum(number > 0 for number in board.inputs)
    names = [f"{place} bumper" for place in places]
    names = names or [f"bumper {number}" for number in range(1, counted + 1)]
    # The numbers are those of `Board.inputs`. If two bumpers have the same place, their names also
    # contain their numbers.
    inputs = {0: "emergency stop"} if estop else {}
    for number, name in enumerate(names, 1):
        inputs[number] = f"{name} ({number})" if names.count(name) > 1 else name
    if not inputs:
        return outcomes.find("inputs: none")
    listed = ", ".join(inputs.values())
    if (estop and 0 not in board.inputs) or (places and counted != len(places)):
        fields = [*["estop=ok"] * estop, *["bumpers=" + "." * len(places)] * bool(places)]
        return outcomes.find("inputs: missing", listed=listed, fields=" ".join(fields))
    question = (
        f"The board has these inputs: {listed}. You will press and release each of them once. Type "
        '"ready" when you stand at the robot, or "skip":'
    )
    if operator.ask(question, ("ready", "skip")) != "ready":
        return outcomes.find("inputs: not pressed", listed=listed)
    wrong = [text for number in inputs if (text := _pressed(board, operator, number, inputs))]
    if wrong:
        right = f"{len(inputs) - len(wrong)} of {len(inputs)} right"
        return outcomes.find("inputs: wrong", figure=right, wrong="; ".join(wrong))
    return outcomes.find("inputs: right", listed=listed)


def _pressed(board: Board, operator: Operator, asked: int, inputs: dict[int, str]) -> str:
    name = inputs[asked]
    operator.doing(f"press the {name} and release it, within {PRESS_TIMEOUT_S:g} s")
    end_s, numbers = board.now_s + PRESS_TIMEOUT_S, set[int]()
    while board.now_s < end_s:
        board.send_zero()
        now = {number for number, pressed in board.inputs.items() if pressed}
        numbers |= now
        if numbers and not now:
            break
    others = [other for number, other in inputs.items() if number in numbers - {asked}]
    if asked not in numbers:
        instead = f"; instead the board reported the {' and the '.join(others)}" if others else ""
        return f"{name}: no press was reported{instead}"
    if others:
        return f"{name}: the board also reported the {' and the '.join(others)}"
    return "" if not now else f"{name}: no release was reported"
