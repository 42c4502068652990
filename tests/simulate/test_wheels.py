"""Tests of the judge of wheels that do not obey: each bound, and what lies just within it."""

from __future__ import annotations

from contextlib import nullcontext

import pytest

from tests.simulate.plan import make_plan
from tests.simulate.promises import BrokenError, Witness
from tests.simulate.roads import NS
from tests.simulate.wheels import Impossible, Wheels

CONFIG = make_plan(1)["config"] | {
    "sim": {"motor_time_constant": 0.1, "encoder_counts": 3200}, "feedback": {},
}  # fmt: skip


def drives(
    seconds: float,
    command: float,
    speed: float,
    lies: str = "reversed_motor",
    found_s: float = 99.0,
    wheels: int = 1,
) -> None:
    """Judge a robot whose first `wheels` wheels have this speed, all rad/s."""
    witness = Witness(CONFIG)
    judge = Wheels(witness, dict)
    witness.last = (command,) * 4
    for n in range(200, 200 + round(seconds * 100)):
        speeds = [speed] * wheels + [command] * (4 - wheels)
        causes = frozenset(("wheel_reversed",) if n >= 200 + found_s * 100 else ())
        judge.see(n * NS // 100, speeds, causes, {lies}, 0)


@pytest.mark.parametrize(("command", "speed"), [(0.5, -0.5), (0.0, 0.5), (0.0, -3.0), (8.0, -8.0)])
def test_a_wheel_against_its_command_or_on_after_a_stop_is_found_within_a_radian(
    command: float, speed: float
) -> None:
    rolled_s = 1.2 / abs(speed) + 0.15
    drives(0.6 + rolled_s - 0.05, command, speed)
    with pytest.raises(BrokenError, match="does not obey is found"):
        drives(0.6 + rolled_s + 0.05, command, speed)
    drives(30.0, command, speed, found_s=0.6 + rolled_s - 0.05)


@pytest.mark.parametrize(("lies", "finding"), [("pushed", False), ("runaway", True)])
def test_a_hand_may_turn_a_wheel(lies: str, finding: bool) -> None:
    with pytest.raises(BrokenError) if finding else nullcontext():
        drives(9.0, 0.0, 1.0, lies)


@pytest.mark.parametrize(
    ("speed", "wheels", "finding"), [(1.2, 4, False), (1.5, 4, True), (1.5, 3, False)]
)
def test_a_robot_whose_wheels_are_all_too_fast_is_stopped(
    speed: float, wheels: int, finding: bool
) -> None:
    with pytest.raises(BrokenError, match="too fast") if finding else nullcontext():
        drives(9.0, 1.0, speed, "gain", wheels=wheels)


@pytest.mark.parametrize(
    ("motors", "left", "seconds", "finding"),
    [((0, 1), -1.0, 5.0, True), ((0, 1), -1.0, 2.5, False), ((0, 3), -1.0, 9.0, False),
     ((0, 1), 0.8, 20.0, False)],
)  # fmt: skip
def test_motors_that_are_swapped_between_the_sides_are_found_in_the_first_turn(
    motors: tuple[int, int], left: float, seconds: float, finding: bool
) -> None:
    config = CONFIG | {"mcu": {"port": "/dev/board"}, "drive": {}}
    witness = Witness(config)
    judge, witness.lies = Wheels(witness, dict), [("swapped_motors", motors)]
    witness.last = (1.0, left, left, 1.0)
    with pytest.raises(BrokenError, match="swapped") if finding else nullcontext():
        for n in range(200, 200 + round(seconds * 100)):
            judge.see(n * NS // 100, list(witness.last), frozenset(), {"swapped_motors"}, 0)


@pytest.mark.parametrize(
    ("fast", "mode", "others", "finding"),
    [(7, "driving", False, True), (6, "driving", False, False), (9, "fault", False, False),
     (9, "driving", True, False)],
)  # fmt: skip
def test_speeds_that_no_wheel_can_have_are_a_fault(
    fast: int, mode: str, others: bool, finding: bool
) -> None:
    judge = Impossible(Witness(CONFIG))
    with pytest.raises(BrokenError, match="impossible") if finding else nullcontext():
        for n in range(20):
            speed = b"95.00" if n < fast else b"05.00"
            judge.fed(b"ap05.00,bn05.00,cp" + speed + b",dp05.00\r\n", others)
            judge.step(n, mode)


@pytest.mark.parametrize(
    ("seconds", "text", "finding"),
    [(2.8, "", False), (3.8, "", True), (9.0, "front_left wheel is blocked, or", False),
     (9.0, "front_right wheel is blocked, or", True)],
)  # fmt: skip
def test_state_names_a_wheel_that_does_not_turn(seconds: float, text: str, finding: bool) -> None:
    witness = Witness(CONFIG)
    judge = Wheels(witness, lambda: {"wheel_fault": text})
    witness.lies = [("dead_motor", (witness.motors[1][0],))]
    witness.last = (1.0,) * 4
    with pytest.raises(BrokenError, match="is named") if finding else nullcontext():
        for n in range(200, 200 + round(seconds * 100)):
            judge.see(n * NS // 100, [1.0, 0.0, 1.0, 1.0], frozenset(), {"dead_motor"}, 0)


@pytest.mark.parametrize(
    ("seconds", "text", "finding"),
    [(3.8, "", False), (5.8, "", True), (9.0, "front_left wheel reports that", False)],
)
def test_state_names_a_wheel_whose_encoder_is_stuck(
    seconds: float, text: str, finding: bool
) -> None:
    witness = Witness(CONFIG)
    judge = Wheels(witness, lambda: {"wheel_fault": text})
    witness.lies = [("stuck_encoder", (witness.motors[1][0],))]
    witness.last = (1.0,) * 4
    with pytest.raises(BrokenError, match="is named") if finding else nullcontext():
        for n in range(200, 200 + round(seconds * 100)):
            judge.see(n * NS // 100, [1.0] * 4, frozenset(), {"stuck_encoder"}, 0)
