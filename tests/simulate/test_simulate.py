"""Tests of the simulator: it repeats a seed exactly, finds a planted fault and shrinks its plan."""

from __future__ import annotations

import json
import math
import random
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from copy import deepcopy
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from acsard.core.config.settings import DriveConfig, JointsConfig
from acsard.core.incoming.commands import Arrival, Receiver
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.latches import stopped
from acsard.core.ros.parameters import requested_values
from acsard.core.values import Latches
from tests.scenarios.world import START
from tests.simulate import __main__ as main
from tests.simulate import pairs, shrink
from tests.simulate.actors import Result, Run, played
from tests.simulate.ages import Wish
from tests.simulate.bad_moments import MOMENTS, NEW
from tests.simulate.board_inputs import Inputs, kinds
from tests.simulate.course import Course
from tests.simulate.damage import Damage
from tests.simulate.followed import Followed
from tests.simulate.gyro_faults import GyroFaults
from tests.simulate.jerk import Slope
from tests.simulate.log_lines import LogLines
from tests.simulate.pairs import OURS, Pair, Trace
from tests.simulate.plan import KINDS, LATER_KINDS, Plan, _rare_events, make_plan
from tests.simulate.plugging import Plugging
from tests.simulate.pose import PoseWitness
from tests.simulate.product import Disk, Product, StepResult, problems
from tests.simulate.promises import ZERO, BrokenError, Witness
from tests.simulate.reasons import Reasons
from tests.simulate.reports import Echo, HalfDuplex, Reports, judge_pose
from tests.simulate.roads import BAD_STAMPS, NS, Message, Sample, messages, parameters, sample
from tests.simulate.spread import Spread
from tests.simulate.unjudged import Unjudged

ODD = {"odd configuration", "extreme timing", "other vehicle", "other dialect"}
PLAIN = next(p for p in map(make_plan, range(99)) if ODD.isdisjoint(p["kinds"]))
EMPTY: Plan = {
    "seed": 0, "seconds": 2.0, "kinds": [], "board": [], "senders": [], "events": [],
    "lawful": "a new client",
}  # fmt: skip


def quiet() -> Plan:
    """Return a plan without senders and events. Only the lawful sender drives at its end."""
    return EMPTY | {"config": PLAIN["config"]}


@pytest.mark.slow
def test_a_seed_gives_the_same_bytes_again_also_when_its_plan_was_written_to_a_file() -> None:
    first, again = Trace(), Trace()
    plan = make_plan(4, 15.0)
    text = json.dumps(plan)
    assert text == json.dumps(make_plan(4, 15.0))
    results = [played(plan, first.step), played(json.loads(text), again.step)]
    assert first.hashes == again.hashes
    assert len(first.hashes) > 15
    assert results[0].finding == results[1].finding == ""


@pytest.mark.slow
def test_every_configuration_of_a_plan_is_legal_and_every_kind_of_trouble_is_drawn() -> None:
    plans = [make_plan(seed) for seed in range(30)]
    assert [problems(plan["config"]) for plan in plans] == [[]] * 30
    assert {kind for plan in plans for kind in plan["kinds"]} == {*KINDS, *LATER_KINDS}


def test_a_sender_sends_the_same_without_the_other_senders() -> None:
    plan = next(p for p in map(make_plan, range(20)) if len(p["senders"]) > 2)
    alone = shrink.without(plan, [("senders", 0)])
    both = [
        messages(plan_["senders"][place], plan_["seed"], plan["seconds"], 0)
        for plan_, place in ((plan, 1), (alone, 0))
    ]
    assert both[0] == both[1] != []


@pytest.mark.slow
def test_some_plans_have_a_bound_of_the_feedback_below_one_encoder_count() -> None:
    """The bound is just above the limit of the wheels, and all these plans are legal."""
    below = 0
    for seed in range(1000):
        config = make_plan(seed, 20.0)["config"]
        bound = config.get("feedback", {}).get("wheel_speed", 80.0)
        if bound < 1.31 * config["limits"]["wheel_speed"]:
            assert problems(config) == []
            counts, rate = config["sim"].get("encoder_counts", 3200), config["control"]["rate"]
            step = math.tau / counts * (100.0 if rate == "auto" else rate)
            below += step > bound
    assert below >= 3


def test_a_quiet_plan_breaks_no_promise() -> None:
    assert played(quiet()).finding == ""


@pytest.mark.slow
def test_a_seed_of_a_replay_is_played_and_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "make_plan", lambda seed: make_plan(seed, 3.0))
    assert main.replay("17") == 0
    assert " s simulated in " in capsys.readouterr().out
    broken = Result(17, "a promise at 2.000 s: so", "a promise", 2 * NS, 2.0, 0.1, Counter())
    monkeypatch.setattr(main, "played", lambda plan: broken)
    assert main.replay("17") == 1
    assert " seed 17: a promise at 2.000 s: so\n" in capsys.readouterr().out


@pytest.mark.slow
def test_seeds_are_played_until_the_time_is_simulated_and_what_they_covered_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "make_plan", lambda seed: make_plan(seed, 3.0))
    assert main.explore(1, 0.012, 2) == 0
    out = capsys.readouterr().out
    assert re.search(r": \d runs from seed 1, 0\.0\d h simulated in .* 0 findings\n", out)
    assert re.search(r"^  way +\w+ \d", out, re.MULTILINE)


@pytest.mark.slow
def test_the_plan_of_each_finding_is_kept_and_the_first_ones_are_shrunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(plan: Plan) -> Result:
        return Result(plan["seed"], "so", "a made-up promise", int(2 * NS), 2.0, 0.1, Counter())

    monkeypatch.setattr(shrink, "played", broken)
    seeds = range(main.MOST_SHRUNK + 1)
    main.keep_plans([broken({"seed": seed}) for seed in seeds], tmp_path / "findings")
    plans = [shrink.load(tmp_path / "findings" / f"{seed}.json") for seed in seeds]
    assert [plan["senders"] for plan in plans[:-1]] == [[]] * main.MOST_SHRUNK
    assert plans[-1] == json.loads(json.dumps(make_plan(main.MOST_SHRUNK)))


# the witness


def moves(witness: Witness, at_s: float) -> None:
    """Give the judge a first line with a low speed."""
    witness.line(
        int(at_s * NS), b"ap00.02,bp00.02,cp00.02,dp00.02\r\n", int(at_s * NS), int(at_s * NS)
    )


def witnessed() -> Witness:
    """Return a judge of a robot that has just started to drive."""
    witness = Witness(PLAIN["config"])
    witness.step(NS // 2, "driving", "commanded", "commanded by app")
    return witness


@pytest.mark.parametrize(
    ("what", "promise"),
    [
        (lambda w: None, "motion needs a fresh wish of an armed sender"),
        (lambda w: w.stops.append(NS // 2), "nothing moves after a stop"),
        (lambda w: w.offs.append(NS // 2), "nothing moves after being switched off"),
        (
            lambda w: w.step(NS, "fault", "wheel_reversed", "it is broken"),
            "no fault without a cause",
        ),
        (lambda w: setattr(w, "linked", False), "only a linked board is driven"),
        (lambda w: w.step(NS, "ready", "commanded"), "every state has a reason"),
        (
            lambda w: w.line(NS, b"ap99.00,bp99.00,cp99.00,dp99.00\r\n", NS, NS),
            "no wheel is over its limit",
        ),
        (
            lambda w: w.line(NS, b"ap05.00,bp05.00,cp05.00,dp05.00\r\n", NS, NS),
            "no acceleration is over its limit",
        ),
        (
            lambda w: w.line(NS, b"ap00.02,bp00.02,cp00.02,dp00.02\r\n", 0, NS),
            "a silent board gets zeros",
        ),
        (lambda w: w.line(NS, b"ap00.02,bp00.02\r\n", NS, NS), "every line is whole"),
        (
            lambda w: w.line(2 * NS, b"ap00.02,bp00.02,cp00.02,dp00.02\r\n", 2 * NS, NS),
            "no line leaves later than it was made",
        ),
    ],
)
def test_the_witness_sees_what_must_not_be(what: Callable[[Witness], None], promise: str) -> None:
    witness = witnessed()

    def run() -> None:
        what(witness)
        moves(witness, 1.0)

    with pytest.raises(BrokenError) as broken:
        run()
    assert broken.value.promise == promise


FREE, HIT = b"!status bumpers=..\r\n", b"!status bumpers=X.\r\n"
OK, PRESSED = b"!status estop=ok*9C94\r\n", b"!status estop=pressed\r\n"
RESTS, MOVES = [
    (0, b",".join(letter + speed for letter in (b"a", b"b", b"c", b"d")) + b"\r\n")
    for speed in (b"p00.00", b"p00.02")
]


def result(
    at_ns: int,
    mode: str,
    reason: str = "a reason",
    link: str = "up",
    lines: Sequence[tuple[int, bytes]] = (),
    events: Sequence[tuple[str, str, str]] = (),
    causes: Iterable[str] = (),
) -> StepResult:
    """Return the result of a step. The first cause is the code of the reason."""
    code, *_ = [*causes, "stopped"]
    seen = mode, code, reason, "", frozenset(causes)
    return StepResult(at_ns, at_ns, *seen, None, link, [*lines], (), events)


class Bench:
    """The judge of the board's inputs with a witness, without a product. Times are in s."""

    def __init__(self, **safety: Any) -> None:
        config = PLAIN["config"] | {"safety": safety}
        self.witness = Witness(config)
        self.witness.step(NS // 2, "driving", "commanded", "commanded by app")
        self.inputs = Inputs(self.witness, True)
        self.state: dict[str, Any] = {}
        self.causes: tuple[str, ...] = ()

    def step(self, at: float, data: bytes = b"", mode: str = "stopped", *lines: Any) -> None:
        """Give the judge a step that reads these bytes and sends these lines."""
        at_ns = round(at * NS)
        if not self.state:
            self.inputs._looked_ns = at_ns  # `state` is not judged
        if data:
            self.inputs.fed(at_ns, data)
        self.inputs.take(at_ns, 0, -NS)
        snapshot = result(at_ns, mode, lines=lines, causes=self.causes)
        self.inputs.step(at_ns, snapshot, 0, True, lambda: self.state)


@pytest.mark.parametrize(
    ("troubles", "finding"), [({"echo"}, True), ({"stalls"}, True), ({"echo", "stalls"}, False)]
)
def test_echoes_that_contradict_the_lines_of_a_stalled_adapter_are_the_cause_of_a_fault(
    troubles: set[str], finding: bool
) -> None:
    witness = Witness(PLAIN["config"])
    witness.step(NS // 2, "driving", "commanded", "commanded by app")
    witness.troubles = dict.fromkeys(troubles, NS)
    with pytest.raises(BrokenError, match="without a cause") if finding else nullcontext():
        witness.step(NS, "fault", "impossible_speeds", "front_right is over feedback.wheel_speed")


def test_a_pressed_input_is_a_stop_until_its_release_and_a_clear_behind_that() -> None:
    bench = Bench(bumpers=["front", "rear"])
    bench.step(1.0, FREE + OK + HIT[:8], "driving", MOVES)
    assert bench.witness.stops == []
    bench.step(1.2, HIT[8:] + HIT + OK, "stopped", RESTS)
    assert bench.witness.stops == [12 * NS // 10]
    with pytest.raises(BrokenError, match="nothing moves while a bumper is pressed"):
        bench.step(1.3, b"", "stopped", MOVES)
    with pytest.raises(BrokenError, match="a bumper that is pressed stops the robot"):
        bench.step(1.3, b"", "ready")
    bench.step(1.4, FREE + PRESSED + OK, "stopped", RESTS)
    assert len(bench.witness.stops) == 2
    bench.step(1.5, OK.replace(b"9C94", b"9C95"))
    bench.step(1.6, PRESSED, "stopped", RESTS)
    with pytest.raises(BrokenError, match="no clear works while an emergency stop is pressed"):
        bench.inputs.cleared(17 * NS // 10)
    bench.step(1.8, OK)
    bench.inputs.cleared(2 * NS)
    with pytest.raises(BrokenError, match="nothing moves after a stop"):
        moves(bench.witness, 2.0)


@pytest.mark.parametrize(
    ("at", "mode", "promise"),
    [
        (1.45, "stopped", "no stop without a cause"),
        (1.53, "stopped", ""),
        (1.53, "driving", ""),
        (1.65, "driving", "an emergency stop that is pressed stops the robot"),
    ],
)
def test_an_input_that_is_silent_for_half_a_second_counts_as_pressed(
    at: float, mode: str, promise: str
) -> None:
    bench = Bench()
    bench.step(1.0, OK, "driving", MOVES)
    with pytest.raises(BrokenError, match=promise) if promise else nullcontext():
        bench.step(at, b"", mode)


@pytest.mark.parametrize(("at", "finding"), [(1.48, True), (1.53, False)])
def test_a_status_line_without_a_check_may_not_end_a_silence(at: float, finding: bool) -> None:
    bench = Bench()
    bench.inputs._checked = True
    bench.step(1.0, OK, "driving", MOVES)
    bench.step(1.4, b"!status estop=ok\r\n", "driving", MOVES)
    bench.witness.perhaps_latched.clear()
    expected = pytest.raises(BrokenError, match="without a cause") if finding else nullcontext()
    with expected:
        bench.step(at, b"", "stopped")


def test_an_input_that_perhaps_never_was_reported_is_not_silent() -> None:
    bench = Bench(bumpers=["front", "rear"])
    bench.inputs._checked = True
    bench.step(1.0, FREE, "waiting", RESTS)
    bench.step(2.0, b"", "waiting", RESTS)
    bench.inputs.cleared(3 * NS)


@pytest.mark.parametrize(("at", "finding"), [(3.9, True), (4.2, False)])
def test_an_input_that_no_line_reports_behind_a_plugging_may_be_forgotten(
    at: float, finding: bool
) -> None:
    bench = Bench()
    bench.step(1.0, OK, "driving", MOVES)
    bench.inputs.plugged(NS)
    bench.step(1.7, b"", "stopped", RESTS)
    promise = "an emergency stop that is pressed stops the robot"
    with pytest.raises(BrokenError, match=promise) if finding else nullcontext():
        bench.step(at, b"", "ready")


def test_a_robot_waits_for_its_inputs_behind_each_plugging() -> None:
    bench = Bench(estop="required")
    bench.step(1.0, OK, "ready")
    bench.inputs.plugged(NS)
    bench.step(1.1, b"", "waiting")
    with pytest.raises(BrokenError, match="a robot waits for its inputs"):
        bench.step(1.2, b"", "ready")
    bench.step(1.3, OK, "ready")


@pytest.mark.parametrize("silent", [True, False])
def test_a_late_answer_to_a_clear_does_not_end_the_doubt_about_a_silence(silent: bool) -> None:
    bench = Bench()
    bench.step(1.0, OK, "driving", MOVES)
    at_ns = 153 * NS // 100
    bench.inputs.fed(at_ns, b"" if silent else OK)
    bench.inputs.take(at_ns, 0, -NS)
    bench.witness.cleared(12 * NS // 10, 11 * NS // 10, CLEARED, "ann")
    snapshot = result(at_ns, "stopped")
    expected = nullcontext() if silent else pytest.raises(BrokenError, match="without a cause")
    with expected:
        bench.inputs.step(at_ns, snapshot, 0, True, dict)


def test_a_pressed_emergency_stop_that_was_silent_is_no_new_press() -> None:
    bench = Bench()
    bench.step(1.0, OK, "driving", MOVES)
    for at in (1.1, 2.0, 2.1):
        bench.step(at, PRESSED if at != 2.0 else b"", "stopped", RESTS)
    assert bench.inputs.estop.silent == ""
    assert bench.witness.stops == [11 * NS // 10]
    bench.step(3.0, b"", "stopped", RESTS)
    bench.step(3.1, OK + PRESSED, "stopped", RESTS)
    assert bench.witness.stops == [11 * NS // 10, 31 * NS // 10]


def test_a_press_without_a_line_in_the_next_period_is_a_finding() -> None:
    for line in (RESTS, None):
        bench = Bench()
        bench.step(1.0, OK, "driving", MOVES)
        bench.witness.last = (1.0,) * 4
        bench.step(1.01, PRESSED)
        if line:
            bench.step(1.02, b"", "stopped", line)
        with nullcontext() if line else pytest.raises(BrokenError, match="within a period"):
            bench.step(1.03)


def test_a_press_beside_a_robot_that_stands_has_its_line_within_two_periods() -> None:
    bench = Bench()
    bench.step(1.0, OK, "ready", RESTS)
    bench.step(1.01, PRESSED)
    bench.step(1.03)
    with pytest.raises(BrokenError, match="within a period"):
        bench.step(1.04)


@pytest.mark.parametrize(
    ("marks", "motors", "finding"),
    [
        (b"X...", (-1, -1), False),
        (b"X...", (1, 1), True),
        (b"X...", (-1, -0.9), True),
        (b"X...", (-3, -3), True),
        (b".X..", (1, 1), False),
        (b"XX..", (-1, -1), True),
        (b"..X.", (-1, -1), True),
        (b"X..X", (-1, -1), False),
    ],
)
def test_a_robot_drives_only_away_from_its_pressed_bumpers(
    marks: bytes, motors: tuple[float, float], finding: bool
) -> None:
    bench = Bench(bumpers=["front", "rear", "left", "front"], bumper="away")
    bench.step(1.0, b"!status bumpers=....\r\n", "driving", MOVES)
    bench.step(1.1, b"!status bumpers=%b\r\n" % marks, "ready", RESTS)
    assert bench.witness.stops == []
    assert bench.witness.armed_since_ns == 11 * NS // 10
    witness = bench.witness
    right, left = (0.05 / witness.radius * motor for motor in motors)
    words = [b""] * 4
    for wheel, speed in enumerate((right, left, left, right)):
        place, sign = witness.motors[wheel]
        letter = b"n" if speed * sign < 0 else b"p"
        words[place] = b"%c%b%05.2f" % (b"abcd"[place], letter, abs(speed))
    with pytest.raises(BrokenError, match="towards a pressed") if finding else nullcontext():
        bench.step(1.2, b"", "driving", (0, b",".join(words) + b"\r\n"))


def test_a_clear_is_obeyed_until_the_silence_behind_a_stall_surely_counts() -> None:
    bench = Bench()
    bench.step(1.0, OK)
    woke_ns = 3 * NS
    bench.inputs.take(woke_ns, 0, woke_ns)
    assert bench.inputs.estop.silent == "maybe"
    surely_ns = woke_ns + NS // 5
    bench.inputs.take(surely_ns, 0, woke_ns)
    bench.inputs.cleared(woke_ns + NS // 100)
    with pytest.raises(BrokenError, match="no clear works while an emergency stop is pressed"):
        bench.inputs.cleared(surely_ns + 1)


def test_a_clear_is_obeyed_while_a_bumper_is_pressed_that_lets_the_robot_drive_away() -> None:
    bench = Bench(bumpers=["front", "rear"], bumper="away")
    bench.step(1.0, HIT, "ready", RESTS)
    bench.inputs.cleared(3 * NS // 2)
    bench.inputs.take(2 * NS, 0, -NS)
    assert bench.inputs.bumpers.silent == "surely"
    bench.inputs.cleared(3 * NS // 2)
    with pytest.raises(BrokenError, match="no clear works while a bumper is pressed"):
        bench.inputs.cleared(2 * NS + 1)


GOOD, FAULTY = b"!status driver=ok\r\n", b"!status driver=fault\r\n"


@pytest.mark.parametrize(
    ("before", "data", "mode", "promise"),
    [
        (OK, FAULTY, "driving", "a fault of a motor driver stops the robot"),
        (OK, FAULTY + GOOD, "ready", "a fault of a motor driver stops the robot"),
        (OK, FAULTY, "fault", ""),
        (OK, FAULTY + PRESSED, "stopped", ""),
        (PRESSED, FAULTY, "stopped", ""),
        (PRESSED, FAULTY, "fault", "drivers without power are no fault"),
        (PRESSED, FAULTY + OK, "stopped", ""),
        (PRESSED, FAULTY + OK, "fault", "drivers without power are no fault"),
        (PRESSED, OK + FAULTY, "stopped", ""),
        (PRESSED, OK + FAULTY, "fault", "drivers without power are no fault"),
        (PRESSED, OK + GOOD + FAULTY, "stopped", ""),
        (PRESSED, OK + GOOD + FAULTY, "fault", "drivers without power are no fault"),
        (OK, PRESSED + FAULTY + OK, "fault", "drivers without power are no fault"),
    ],
)
def test_a_fault_of_a_motor_driver_stops_the_robot_unless_its_emergency_stop_is_pressed(
    before: bytes, data: bytes, mode: str, promise: str
) -> None:
    bench = Bench()
    bench.step(1.0, before, "driving" if before is OK else "stopped", RESTS)
    bench.causes = ("driver_fault",)
    bench.step(1.05, b"", "driving" if before is OK else "stopped", RESTS)
    with pytest.raises(BrokenError, match=promise) if promise else nullcontext():
        bench.step(1.1, data, mode, RESTS)


@pytest.mark.parametrize(
    ("before", "cause", "finding"),
    [
        (PRESSED, "emergency_stop", False),
        (OK, "emergency_stop", True),
        (PRESSED, "emergency_stop_silent", True),
        (PRESSED, "stopped", True),
    ],
)
def test_a_new_daemon_takes_no_driver_fault_behind_the_emergency_stop_of_its_latch_file(
    before: bytes, cause: str, finding: bool
) -> None:
    bench = Bench()
    bench.step(1.0, before, "stopped", RESTS)
    bench.step(1.05, OK, "stopped", RESTS)
    bench.step(1.1, OK, "ready", RESTS)
    bench.inputs.new_life()
    bench.causes = (cause,)
    bench.step(2.0, OK, "stopped", RESTS)
    expected = pytest.raises(BrokenError, match="a fault of a motor driver stops the robot")
    with expected if finding else nullcontext():
        bench.step(2.1, FAULTY, "stopped", RESTS)


def test_no_clear_works_until_the_board_reports_that_the_motor_drivers_are_in_order() -> None:
    bench = Bench()
    bench.step(1.0, FAULTY, "fault", RESTS)
    bench.inputs.cleared(9 * NS // 10)
    with pytest.raises(BrokenError, match="no clear works while a motor driver has a fault"):
        bench.inputs.cleared(11 * NS // 10)
    bench.step(1.2, GOOD, "fault", RESTS)
    bench.inputs.cleared(13 * NS // 10)


def test_a_fault_of_a_motor_driver_needs_a_line_that_reports_it() -> None:
    for data in (FAULTY, GOOD):
        bench = Bench()
        bench.inputs.fed(NS, data)
        bench.inputs.take(NS, 0, -NS)
        expected = pytest.raises(BrokenError, match="no fault without a cause")
        with expected if data is GOOD else nullcontext():
            bench.witness.step(NS, "fault", "driver_fault", "why")


def test_a_battery_stops_the_robot_by_its_mean_and_not_by_a_motor_start() -> None:
    bench = Bench()
    config = {"measure": "volts", "stop_below": 22.0}
    bench.witness.config = bench.witness.config | {"battery": config}
    bench.inputs = Inputs(bench.witness, True)

    def report(begin: int, end: int, volts: float, mode: str) -> None:
        for tenth in range(begin, end):
            bench.step(tenth / 10, b"!status volts=%05.2f amps=-1.00\r\n" % volts, mode)

    report(10, 100, 23.0, "driving")
    report(100, 103, 21.0, "driving")
    with pytest.raises(BrokenError, match="no stop without a cause"):
        bench.step(10.3, b"", "stopped")
    bench.step(10.31, b"", "driving")
    report(104, 160, 21.0, "driving")
    with pytest.raises(BrokenError, match="an empty battery stops the robot"):
        report(160, 200, 21.0, "driving")
    report(200, 210, 21.0, "stopped")
    assert len(bench.witness.stops) == 1
    with pytest.raises(BrokenError, match="no clear works while the battery is empty"):
        bench.inputs.cleared(21 * NS)
    report(210, 400, 25.0, "stopped")
    bench.inputs.cleared(40 * NS)


@pytest.mark.slow
def test_some_plans_have_inputs_and_are_legal_and_an_older_product_gets_none() -> None:
    plans = list(map(make_plan, range(200)))
    with_inputs = [plan for plan in plans if kinds(plan)]
    for kind in ("estop", "stop", "away", "battery", "driver_fault"):
        assert 4 <= sum(kind in kinds(plan) for plan in plans) <= 30
    for plan in with_inputs:
        assert problems(plan["config"]) == []
        if kinds(plan) == {"stop"} and "moment" not in plan:
            faults = {event["fault"][0] for event in plan["events"] if event["do"] == "board"}
            assert faults == {"bumper_pressed"}
            assert not {"reset", "restart", "unplug"} & {event["do"] for event in plan["events"]}
        older = pairs.comparable(plan)
        text = json.dumps([older["config"], older["board"], older["events"]])
        assert not {"safety", "battery", "estop", "bumper"} & set(re.findall("[a-z]+", text))


@pytest.mark.slow
def test_a_plan_with_bumpers_breaks_no_promise_and_a_robot_that_ignores_them_does() -> None:
    plans = [item for item in map(make_plan, range(100)) if kinds(item) == {"stop"}]
    plan = min(plans, key=lambda item: item["seconds"])
    result = played(plan)
    assert result.finding == ""
    assert result.counts["bumper pressed"] > 0
    ignored = deepcopy(plan)
    ignored["config"]["safety"]["bumper"] = "off"
    assert played(ignored).promise in (
        "nothing moves after a stop", "nothing moves while a bumper is pressed",
        "a bumper that is pressed stops the robot", "state has the inputs of the board",
    )  # fmt: skip


def driven(**changes: Any) -> Plan:
    """Return a plan in which a lawful sender drives from 1.3 s on."""
    source = max(PLAIN["config"]["commands"]["sources"], key=lambda entry: entry["priority"])
    clean = {
        "wheels": False, "hz": 50.0, "from": 0.0, "to": 12.0, "jitter": 0.0, "congestion": [],
        "clock": [], "bursts": [], "bad_stamps": 0.0, "junk": 0.0, "churn": False, "loss": 0.0,
        "twice": 0.0, "swap": 0.0, "phases": [[0.0, 0.0, 0.0], [1.3, 0.3, 0.0]],
    }  # fmt: skip
    sender = PLAIN["senders"][0] | clean | {"way": "plain", "source": source["name"]}
    return quiet() | {"seconds": 12.0, "senders": [sender]} | changes


@pytest.mark.slow
def test_in_a_quarter_of_the_plans_nobody_outranks_a_sender_that_keeps_all_rules() -> None:
    plans = [plan for plan in map(make_plan, range(100)) if "moment" not in plan]
    lawful = sum(bool(Run(plan).liveness.lawful) for plan in plans)
    assert 0.15 <= lawful / len(plans) <= 0.4


@pytest.mark.slow
@pytest.mark.parametrize("noted", [True, False])
def test_a_sender_that_must_send_a_zero_without_an_event_is_a_finding(noted: bool) -> None:
    run = Run(driven(events=[{"at": 8.0, "do": "reset", "deaf": 0.3}]))
    if not noted:
        run.liveness.event = lambda *_, **__: None  # type: ignore[method-assign]
    broken = pytest.raises(BrokenError, match="an armed sender stays armed")
    with nullcontext() if noted else broken:
        run.play()
    assert run.counts["lawful looks"] > 100


@pytest.mark.slow
def test_a_zero_whose_pause_was_interrupted_by_a_stall_arms_nobody_behind_the_next_stall() -> None:
    """The judge does not expect the robot to drive after such a zero (seed 2702000061)."""
    stalls = [{"at": 2.6, "do": "stall", "for": 0.5}, {"at": 7.0, "do": "stall", "for": 0.2}]
    plan = driven(events=stalls)
    plan["senders"][0] |= {"from": 2.0, "phases": [[2.0, 0.0, 0.0], [3.49, 0.3, 0.0]]}
    result = played(plan)
    assert (result.finding, result.counts["lawful looks"]) == ("", 0)


@pytest.mark.slow
def test_a_plan_may_switch_the_robot_off_behind_its_end() -> None:
    """The judge accepts a late `deactivate` during the lawful drive at the end (seed 182028330)."""
    call = {"verb": "deactivate", "late": 0.0, "lost": False, "twice": False, "via": "native"}
    plan = quiet() | {"events": [{"at": 8.0, "do": "call", "by": "op1", **call}]}
    result = played(plan)
    assert (result.finding, result.counts["deactivate done"]) == ("", 1)


def ramp(witness: Witness, fastest: float, share: float) -> None:
    """Give the judge lines that ramp down from this speed at `share` times the deceleration."""
    radius, fall = witness.radius, witness.limits["linear_deceleration"]
    for n in range(1, 400):
        speed = fastest - n * 0.01 * share * fall / radius
        if speed <= 0.0:
            return
        words = [letter + b"p%05.2f" % speed for letter in (b"a", b"b", b"c", b"d")]
        at_ns = NS + n * NS // 100
        witness.line(at_ns, b",".join(words) + b"\r\n", at_ns, at_ns)


@pytest.mark.parametrize(
    ("stopped", "promise"),
    [
        (False, "without a wish the robot comes to rest"),
        (True, "nothing moves after being switched off"),
    ],
)
def test_a_ramp_that_takes_twice_as_long_as_from_its_own_speed_is_a_finding(
    stopped: bool, promise: str
) -> None:
    for share in (1.0, 0.5):
        witness = witnessed()
        fastest = 0.6 * witness.limits["linear_deceleration"] / witness.radius
        witness.limits["wheel_speed"] = witness.softest["wheel_speed"] = 2 * fastest
        witness.limits["linear_speed"] = witness.softest["linear_speed"] = 99.0
        witness.last, witness.last_ns = (fastest,) * 4, NS
        if stopped:
            witness.offs.append(NS)
        if share == 1.0:
            ramp(witness, fastest, share)
        else:
            with pytest.raises(BrokenError, match=promise):
                ramp(witness, fastest, share)


@pytest.mark.parametrize(("gap_s", "finding"), [(0.29, False), (0.31, True)])
def test_a_robot_goes_on_at_full_speed_only_if_its_board_cannot_have_stopped(
    gap_s: float, finding: bool
) -> None:
    witness = witnessed()
    witness.limits["linear_speed"] = 99.0
    witness.last, witness.last_ns = (8.0,) * 4, NS
    at_ns = NS + int(gap_s * NS)
    promise = "no acceleration is over its limit"
    with pytest.raises(BrokenError, match=promise) if finding else nullcontext():
        witness.line(at_ns, b"ap08.00,bp08.00,cp08.00,dp08.00\r\n", at_ns, at_ns)


@pytest.mark.parametrize("first", [True, False])
def test_the_stop_that_opens_a_port_takes_the_place_of_a_line_whose_speed_may_have_grown(
    first: bool,
) -> None:
    witness = witnessed()
    witness.linked, witness.first = True, first
    witness.limits["linear_acceleration"] = 1.0
    zero, grown = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n", b"ap00.40,bp00.40,cp00.40,dp00.40\r\n"
    at_ns = NS
    witness.line(at_ns, zero, at_ns, at_ns)
    # The bench has no sender, which is the next promise to be judged.
    promise = "motion needs a fresh wish" if first else "no acceleration is over its limit"
    with pytest.raises(BrokenError, match=promise):
        witness.line(at_ns + NS // 100, grown, at_ns, at_ns + NS // 100)


@pytest.mark.parametrize(("speed", "raises"), [(5.0, True), (3.0, False)])
def test_a_wheel_that_clearly_does_not_obey_must_become_a_fault(speed: float, raises: bool) -> None:
    witness = witnessed()
    witness.lies = [("reversed_motor", (witness.motors[2][0],))]

    def drive() -> None:
        for n in range(100, 450):
            witness.obeyed(n * NS // 100, (0.0, 0.0, -speed, 0.0))

    expected = pytest.raises(BrokenError, match="does not obey") if raises else nullcontext()
    with expected:
        drive()


def test_a_hand_that_turns_wheels_at_rest_causes_no_fault() -> None:
    witness = witnessed()
    witness.line(NS, b"ap00.00,bp00.00,cp00.00,dp00.00\r\n", NS, NS)
    witness.wheels(2 * NS, 0.0)
    witness.wheels(5 * NS // 2, 0.0)
    witness.troubles["pushed"] = 3 * NS
    witness.wheels(3 * NS, 9.0)
    with pytest.raises(BrokenError, match="no fault without a cause"):
        witness.step(3 * NS, "fault", "wheel_runaway", "why")


@pytest.mark.parametrize(("steps", "visible"), [(8, True), (0, False)])
def test_wheels_that_rest_only_while_the_host_stalls_may_look_like_a_runaway(
    steps: int, visible: bool
) -> None:
    witness = witnessed()
    witness.rested = False
    for n in range(steps + 1):
        witness.wheels(NS + n * NS // 4, 0.0)
    witness.wheels(13 * NS // 4, 0.0)
    witness.troubles["pushed"] = 7 * NS // 2
    witness.wheels(7 * NS // 2, 9.0)
    expected = pytest.raises(BrokenError, match="without a cause") if visible else nullcontext()
    with expected:
        witness.step(4 * NS, "fault", "wheel_runaway", "why")


def test_a_pose_may_not_jump_although_the_encoders_missed_a_part_of_the_drive() -> None:
    pose, sure = PoseWitness({}), (0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
    truth = 0, 0.0, 0.0, 0.0, 0.0
    pose.see(0, [(0, 1.0, 1.0, 0.0, sure, ())], truth, 0, set())
    pose.doubt()
    with pytest.raises(BrokenError, match="the pose never jumps"):
        pose.see(NS // 10, [(NS // 10, 9.0, 1.0, 0.0, sure, ())], truth, 0, set())
    pose.begin()
    pose.see(NS // 5, [(NS // 5, 1.0, 1.0, 0.0, sure, ())], truth, 0, set())


def hung(seconds: float, off: float, deviation: float) -> None:
    """Judge a robot whose gyro hangs, and whose heading is then wrong by `off`."""
    pose, gyro = PoseWitness({"odometry": {"gyro": True}}), GyroFaults()
    covariance = (0.0001, 0.0, 0.0, 0.0001, 0.0, deviation**2)

    def step(at_ns: int, yaw: float) -> None:
        pose.gyro(at_ns, gyro)
        truth = at_ns, 0.0, 0.0, 0.0, 0.0
        pose.see(at_ns, [(at_ns, 0.0, 0.0, yaw, covariance, ())], truth, 0, set())

    step(0, 0.0)
    gyro.hanging = True
    assert gyro.reported(0.5) == gyro.reported(0.0) == 0.5
    for n in range(1, int(seconds * 100)):
        step(n * NS // 100, off if n > 5 else 0.0)
    gyro.hanging = False
    assert gyro.reported(0.0) == 0.0
    for n in range(int(seconds * 100), int(seconds * 100) + 100):
        step(n * NS // 100, off)


def test_the_turn_of_a_gyro_that_hangs_may_stay_only_for_a_moment() -> None:
    with pytest.raises(BrokenError, match="the wheels give the turn of a gyro that hangs"):
        hung(0.9, 0.3, 0.01)
    hung(0.7, 0.3, 0.01)
    hung(0.9, 0.02, 0.01)
    hung(0.9, 0.3, 0.1)


@pytest.mark.parametrize(("rate", "allowed"), [(0.5, True), (3.0, False)])
def test_only_a_wrong_sample_near_the_true_rate_may_count(rate: float, allowed: bool) -> None:
    gyro = GyroFaults()
    gyro.spoil(rate)
    assert [gyro.reported(0.0), gyro.reported(0.0)] == [rate, 0.0]
    assert gyro.spoiled == pytest.approx(0.02 * rate if allowed else 0.0)


@pytest.mark.parametrize(("speed", "finding"), [(0.5, False), (0.7, True)])
def test_a_robot_may_not_speed_up_by_a_speed_that_a_zero_overtook(
    speed: float, finding: bool
) -> None:
    witness = witnessed()
    followed = Followed(witness)
    source = witness.config["commands"]["sources"][0]["name"]
    sender = {"way": "rmw", "source": source, "clock": [], "stamps_speeds": True, "ends": []}
    for number, v, at_ns in ((1, 1.0, NS), (3, 0.0, NS + 50_000_000), (2, 1.0, NS + 52_000_000)):
        message = Message(at_ns, at_ns, v, 0.0, at_ns, number, "")
        clock = "header s0" if v else "s0"
        value = Sample(f"cmd/{source}", b"", {}, "s0", False, clock)
        wish = Wish(at_ns, v, 0.0)
        followed.command(sender, message, value, at_ns, wish)
    witness.mode = "driving"
    followed.step(at_ns + 1, at_ns + 1, at_ns, "driving", "up")
    assert followed.wish is None
    before, after = ((value / witness.radius,) * 4 for value in (0.6, speed))
    if finding:
        with pytest.raises(BrokenError, match="a speed that a zero overtook"):
            followed.line(at_ns, before, after)
    else:
        followed.line(at_ns, before, after)


@pytest.mark.parametrize(
    ("clock", "later", "excused"),
    [([], 0.9, False), ([["step", 2.0, -3.0]], 0.9, True), ([["step", 2.0, -3.0]], 1.1, False)],
)
def test_only_a_zero_before_a_clock_was_set_back_may_have_a_stamp_that_is_later_by_the_timeout(
    clock: list[Any], later: float, excused: bool
) -> None:
    witness = witnessed()
    followed = Followed(witness)
    source = witness.config["commands"]["sources"][0]["name"]
    sender = {"way": "rmw", "source": source, "clock": clock}
    zero_ns = 4 * NS + round(later * witness.timeout[source])
    for number, v, at_ns, stamp_ns in ((1, 0.0, NS, zero_ns), (2, 1.0, 9 * NS, 4 * NS)):
        message = Message(at_ns, at_ns, v, 0.0, stamp_ns, number, "")
        command = Sample(f"cmd/{source}", b"", {}, "s0", False, "s0")
        followed.command(sender, message, command, at_ns, Wish(at_ns, v, 0.0))
    witness.mode = "driving"
    followed.step(at_ns + 1, at_ns + 1, at_ns, "driving", "up")
    assert followed.wish == (None if excused else (1.0, 0.0))


def test_a_drive_may_end_with_a_single_zero_that_overtakes_the_last_speed() -> None:
    phases = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    sender = driven()["senders"][0] | {"id": "s0", "way": "rmw", "phases": phases}
    sender |= {"stamps_speeds": True, "ends": [[1.0, True]]}
    sent = messages(sender, 1, 2.0, 0)
    zeros = [message for message in sent if message.sent_ns >= NS]
    assert len(zeros) == 1
    assert sent[-2:] == [zeros[0], sent[-1]]
    assert sent[-1].number == zeros[0].number - 1
    clocks = [sample(sender, message, PLAIN["config"], 0).clock for message in sent[-2:]]
    assert clocks == ["s0", "header s0"]


CLEARED = "cleared; each sender must send a zero"


def test_a_clear_that_its_sender_sent_before_the_stop_must_not_release_it() -> None:
    witness = witnessed()
    witness.stops.append(5 * NS)
    with pytest.raises(BrokenError, match="releases no later stop"):
        witness.cleared(9 * NS, 4 * NS, CLEARED, "ann")
    witness.cleared(9 * NS, 6 * NS, CLEARED, "ann")
    assert witness.must_rest is None


def test_a_clear_of_a_robot_that_is_switched_off_releases_the_stop() -> None:
    witness = witnessed()
    witness.stops.append(5 * NS)
    text = "cleared, but the robot is still switched off: call srv/activate to switch it on"
    witness.cleared(9 * NS, 6 * NS, text, "ann")
    assert witness.stops == []


@pytest.mark.parametrize(("at_s", "finding"), [(6.9, True), (7.0, False)])
def test_a_clear_without_numbers_must_wait_behind_a_start(at_s: float, finding: bool) -> None:
    witness = witnessed()
    witness.stops.append(2 * NS)
    witness.new_life(5 * NS)
    promise = "a clear releases no later stop"
    with pytest.raises(BrokenError, match=promise) if finding else nullcontext():
        witness.cleared(int(at_s * NS), None, CLEARED, "ann")


LEFT = "cleared, but the robot is still stopped by joe: call srv/clear again"


def test_a_clear_that_leaves_a_stop_releases_only_what_its_sender_had_read() -> None:
    witness = witnessed()
    witness.stops += [2 * NS, 5 * NS]
    witness.cleared(9 * NS, 4 * NS, LEFT, "ann")
    assert witness.stops == [5 * NS]


@pytest.mark.parametrize(("at_s", "finding"), [(6.9, True), (7.0, False)])
def test_a_plain_clear_that_leaves_the_stop_must_wait_behind_it(at_s: float, finding: bool) -> None:
    witness = witnessed()
    witness.fault_ns, witness.stops = 2 * NS, [5 * NS]
    promise = "a clear releases no later stop"
    with pytest.raises(BrokenError, match=promise) if finding else nullcontext():
        witness.cleared(int(at_s * NS), None, LEFT, "ann")
        assert witness.must_rest == (5 * NS, "a stop")


def test_a_plain_clear_must_leave_the_stop_below_a_fault() -> None:
    witness = witnessed()
    witness.fault_ns, witness.stops = 2 * NS, [3 * NS]
    with pytest.raises(BrokenError, match="a plain clear releases the faults first"):
        witness.cleared(9 * NS, None, CLEARED, "ann")


@pytest.mark.parametrize(
    ("read_s", "at_s", "finding"),
    [(2.9, 9.0, True), (3.1, 3.2, False), (None, 4.9, True), (None, 5.0, False)],
)
def test_a_clear_releases_no_cause_of_a_fault_that_its_sender_has_not_seen(
    read_s: float | None, at_s: float, finding: bool
) -> None:
    witness = witnessed()
    witness.fault_ns, witness.faults = 2 * NS, [2 * NS, 3 * NS]
    promise = "a clear releases no later fault"
    with pytest.raises(BrokenError, match=promise) if finding else nullcontext():
        read_ns = None if read_s is None else int(read_s * NS)
        witness.cleared(int(at_s * NS), read_ns, CLEARED, "ann")
        assert witness.must_rest is None
        assert not witness.faults


@pytest.mark.parametrize(("junk", "armed"), [("not a number", False), ("stranger", True)])
def test_a_zero_before_what_may_be_a_speed_of_the_same_identity_arms_nobody(
    junk: str, armed: bool
) -> None:
    witness = witnessed()
    sender = make_plan(1)["senders"][0] | {"way": "plain", "source": "app", "churn": False}
    for at_s, v, kind in ((1.0, 0.0, ""), (1.5, 0.0, junk), (2.5, 0.3, "")):
        message = Message(int(at_s * NS), int(at_s * NS), v, 0.0, 0, 0, kind)
        witness.command(
            sender, message, sample(sender, message, PLAIN["config"], 0), message.arrives_ns
        )
    assert (witness.wishes[-1][1].armed_ns == NS) is armed


@pytest.mark.parametrize(("way", "armed"), [("routed", False), ("bridge", False), ("signed", True)])
def test_a_speed_of_another_shared_identity_of_the_source_undoes_a_zero(
    way: str, armed: bool
) -> None:
    witness = witnessed()
    plain = make_plan(1)["senders"][0] | {"way": "plain", "source": "app", "churn": False}
    other = plain | {"way": way, "routers": [[0.0, "session of router 1"]]}
    for at_s, sender, v in ((1.0, plain, 0.0), (1.5, other, 0.3), (2.5, plain, 0.3)):
        message = Message(int(at_s * NS), int(at_s * NS), v, 0.0, NS, 0, "")
        witness.command(
            sender, message, sample(sender, message, PLAIN["config"], NS), message.arrives_ns
        )
    assert (witness.wishes[-1][1].armed_ns == NS) is armed


@pytest.mark.parametrize(("junk", "lost"), [("not a number", False), ("", True)])
def test_an_unreadable_or_lost_message_of_another_shared_identity_undoes_no_zero(
    junk: str, lost: bool
) -> None:
    witness = witnessed()
    plain = make_plan(1)["senders"][0] | {"way": "plain", "source": "app", "churn": False}
    other = plain | {"way": "bridge"}
    for at_s, sender, v, kind in (
        (0.5, other, 0.0, ""), (1.0, plain, 0.0, ""),
        (1.5, other, 0.3, junk), (2.5, plain, 0.3, ""),
    ):  # fmt: skip
        message = Message(int(at_s * NS), int(at_s * NS), v, 0.0, NS, 0, kind)
        put = sample(sender, message, PLAIN["config"], NS)
        witness.command(sender, message, put, message.arrives_ns)
        if lost and at_s == 1.5:
            witness.dropped(put.key)
        else:
            witness.read()
    assert witness.wishes[-1][1].armed_ns == NS


def test_a_sender_behind_routers_has_the_identity_of_the_session_that_stamps() -> None:
    routers = [[0.0, "session of router 1"], [2.0, ""], [3.0, "session of router 2"]]
    sender = make_plan(1)["senders"][0] | {"way": "routed", "source": "app", "churn": False}
    sender["routers"] = routers
    identities = []
    for at_s in (1, 2, 4):
        message = Message(at_s * NS, at_s * NS, 0.3, 0.0, NS, 1, "")
        command = sample(sender, message, PLAIN["config"], NS)
        identities.append(
            (command.identity, command.clock, command.options["session"], command.shared)
        )
    first, _, last = [name for _, name in routers]
    assert identities == [
        (first, first, first, True), ("native/app", "", "", True), (last, last, last, True)
    ]  # fmt: skip


@pytest.mark.slow
def test_some_plans_have_several_senders_behind_routers_on_one_source() -> None:
    together = 0
    for seed in range(200):
        senders = [sender for sender in make_plan(seed)["senders"] if sender["way"] == "routed"]
        assert all(sender["routers"][0][0] == 0.0 for sender in senders)
        together += len(senders) > 1 and len({sender["source"] for sender in senders}) == 1
    assert together > 3


@pytest.mark.parametrize("dropped", [True, False])
def test_a_robot_does_not_learn_the_delay_of_a_command_that_the_inbox_dropped(
    dropped: bool,
) -> None:
    witness = witnessed()
    sender = make_plan(1)["senders"][0] | {
        "way": "client", "source": "app", "id": "ann", "churn": False, "delay": 0.001, "clock": []
    }  # fmt: skip

    def arrives(at_ns: int, delay_ns: int) -> None:
        message = Message(at_ns - delay_ns, at_ns, 0.3, 0.0, at_ns - delay_ns, 1, "")
        witness.command(sender, message, sample(sender, message, PLAIN["config"], 0), at_ns)

    arrives(5 * NS, NS)
    if dropped:
        witness.dropped("cmd/app")
    witness.read()
    for number in range(20):
        arrives(6 * NS + number * NS // 20, 3 * NS)
        witness.read()
    assert not witness.wishes[0][1].fresh
    assert witness.wishes[-1][1].fresh is dropped


def test_a_daemon_that_has_ended_writes_nothing_when_the_disk_has_room_again() -> None:
    disk = Disk()
    disk.fill(True)
    disk.keep(stopped(Latches(), "ann", 0))
    assert disk.behind
    disk.end()
    disk.fill(False)
    assert disk.read(START).causes == ()
    assert not disk.behind


def test_a_stop_that_had_no_answer_may_be_gone_after_a_restart() -> None:
    witness = witnessed()
    witness.stops += [2 * NS, 4 * NS]
    witness.unanswered("stop", 4 * NS)
    assert witness.stops == [2 * NS]


@pytest.mark.parametrize("pending", [True, False])
def test_a_clear_without_an_answer_releases_no_stop_that_came_behind_it(pending: bool) -> None:
    witness = witnessed()
    witness.stops += [2 * NS, 5 * NS]
    if pending:
        witness.pending = {"clear": 3 * NS}
    else:
        witness.unanswered("clear", 3 * NS)
    with pytest.raises(BrokenError, match="nothing moves after a stop"):
        moves(witness, 6.0)


@pytest.mark.parametrize(
    ("began", "took_s", "promise"),
    [(1.0, 0.2, "the last line of an orderly end is a zero"), (99.0, 0.6, "")],
)
def test_the_last_line_of_an_orderly_end_is_a_zero(
    began: float, took_s: float, promise: str
) -> None:
    witness = witnessed()
    fast = began * 0.1 * witness.limits["linear_stop_deceleration"] / witness.radius
    witness.ending_ns, witness.last = NS, (0.1,) * 4
    with pytest.raises(BrokenError, match=promise) if promise else nullcontext():
        witness.ended(NS + int(took_s * NS), (fast,) * 4)


def test_a_robot_that_speeds_up_after_sigterm_is_a_finding() -> None:
    witness = witnessed()
    witness.ending_ns = NS
    with pytest.raises(BrokenError, match="nothing moves after SIGTERM"):
        moves(witness, 1.1)


@pytest.mark.parametrize(
    ("share", "every", "finding"), [(1.0, 1, False), (0.5, 1, True), (0.5, 6, False)]
)
def test_a_ramp_with_all_its_lines_that_takes_twice_as_long_is_a_finding(
    share: float, every: int, finding: bool
) -> None:
    witness = witnessed()
    witness.limits["wheel_speed"] = witness.limits["linear_speed"] = 99.0
    course, fall = Course(witness), witness.limits["linear_deceleration"]
    wheel = 1.0 * fall / witness.radius
    with pytest.raises(BrokenError, match="a ramp ends in time") if finding else nullcontext():
        for n in range(0, 200, every):
            speed = max(0.5 * wheel, wheel * (1 - n * 0.01 * share))
            course.step(n * NS // 100, (0.5 * fall, 0.0), (speed,) * 4, 1)


@pytest.mark.parametrize(("factor", "finding"), [(1.0, False), (100.0, True)])
def test_a_covariance_that_no_motion_explains_is_a_finding(factor: float, finding: bool) -> None:
    spread = Spread(Witness(PLAIN["config"]))
    with pytest.raises(BrokenError, match="grows by motion only") if finding else nullcontext():
        for n in range(1000):
            x = 0.005 * n
            place, yaw = factor * 1e-4 * x, factor * 1e-4 * x
            covariance = (place, 0.0, 0.0, place + yaw * x * x / 3, 0.0, yaw)
            spread.see(2 * NS, (n * NS // 100, x, 0.0, 0.0, covariance, ()), set())


@pytest.mark.parametrize(("counts", "finding"), [(400, False), (3200, True)])
def test_lines_in_quick_succession_from_coarse_encoders_look_like_slip(
    counts: int, finding: bool
) -> None:
    spread = Spread(Witness(PLAIN["config"] | {"sim": {"encoder_counts": counts}}))
    with pytest.raises(BrokenError, match="grows by motion only") if finding else nullcontext():
        for n in range(1000):
            x = 0.0025 * n
            covariance = (1e-2 * x, 0.0, 0.0, 1e-2 * x, 0.0, 1e-2 * x)
            spread.see(2 * NS, (n * NS // 200, x, 0.0, 0.0, covariance, ()), set())


@pytest.mark.parametrize(
    ("changes", "restarts", "finding"),
    [(True, False, True), (True, True, False), (False, False, False)],
)
def test_an_echo_must_be_known_soon_after_a_change_of_speed(
    changes: bool, restarts: bool, finding: bool
) -> None:
    echo = Echo()
    echo.begin()
    with pytest.raises(BrokenError, match="an echo is no board") if finding else nullcontext():
        for n in range(1, 200):
            if restarts and n == 120:
                echo.restart()
            echo.line(n * NS // 100, (0.2 * max(0, n - 40) if changes else 0.2,) * 4)


def test_a_new_daemon_has_its_own_time_to_find_its_output_blocked() -> None:
    witness = Witness(PLAIN["config"])
    witness.blocked_ns = NS
    witness.new_life(5 * NS)
    witness.step(51 * NS // 10, "driving", "commanded", "commanded by app", fed_ns=5 * NS)
    with pytest.raises(BrokenError, match="a blocked board is not driven"):
        witness.step(
            56 * NS // 10, "driving", "commanded", "commanded by app", fed_ns=55 * NS // 10
        )


@pytest.mark.parametrize("away", [True, False])
def test_away_from_a_bumper_a_robot_that_may_not_turn_goes_as_fast_as_it_is_asked(
    away: bool,
) -> None:
    witness = witnessed()
    witness.away = away
    fast = witness.limits["angular_speed"]
    wish = SimpleNamespace(v=-0.1, w=10.0 * fast)
    wheels = (-0.1 / witness.radius,) * 4
    assert witness._leads(wish, wheels, ZERO) == away  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("times_ms", "name", "promise"),
    [
        ((0, 0, 0, 0, 0, 1000, 2000), "fault", ""),
        ((0, 0, 0, 0, 0, 10, 20), "fault", "the log is not flooded"),
        ((0, 7000), "fault", "a change of the mode is logged"),
        ((0, 7000), "mode", ""),
    ],
)
def test_the_judge_of_the_log_counts_its_lines_and_wants_each_mode_there(
    times_ms: tuple[int, ...], name: str, promise: str
) -> None:
    log = LogLines()
    log.see(0, result(0, "ready"))
    with pytest.raises(BrokenError, match=promise) if promise else nullcontext():
        for at_ms in times_ms:
            at_ns, line = at_ms * NS // 1000, (name, "info", "ready -> driving: so")
            log.see(at_ns, result(at_ns, "driving", events=[line]))


@pytest.mark.parametrize(
    ("lasted_s", "stood", "late"), [(3, True, True), (0.1, True, False), (3, False, False)]
)
def test_behind_a_suspend_only_a_sender_that_was_proved_before_may_be_called_late(
    lasted_s: float, stood: bool, late: bool
) -> None:
    witness = witnessed()
    run: Any = SimpleNamespace(witness=witness)
    reasons = Reasons(run)
    end_ns = 4 * NS
    for at_ns in (*range(end_ns - int(lasted_s * NS), end_ns, NS // 20), end_ns):
        if at_ns == end_ns:
            reasons.restart(stood)
        message = Message(at_ns, at_ns, 0.1, 0.0, at_ns, at_ns, "")
        command = sample(SIGNED, message, PLAIN["config"], 0)
        witness.command(SIGNED, message, command, at_ns)
        reasons.command(SIGNED, message, command)
    assert ("late" in reasons.allowed("app", end_ns)) is late


@pytest.mark.parametrize(("stalled_s", "after_s", "excused"), [
    (3.1, 0.2, True), (2.9, 0.2, False), (3.1, 5.0, False),
])  # fmt: skip
def test_only_a_sender_that_was_silent_since_a_stall_may_wait_because_of_it(
    stalled_s: float, after_s: float, excused: bool
) -> None:
    witness = witnessed()
    witness.timeout["app"] = NS
    run: Any = SimpleNamespace(witness=witness)
    reasons, at_ns = Reasons(run), 3 * NS
    message = Message(at_ns, at_ns, 0.1, 0.0, at_ns, 1, "")
    command = sample(SIGNED, message, PLAIN["config"], 0)
    witness.command(SIGNED, message, command, at_ns)
    reasons.command(SIGNED, message, command)
    reasons._stalled_ns = int(stalled_s * NS)
    assert ("stalled" in reasons.allowed("app", int((stalled_s + after_s) * NS))) is excused


def test_a_shared_identity_may_wait_for_a_zero_behind_messages_that_were_dropped() -> None:
    witness = witnessed()
    run: Any = SimpleNamespace(witness=witness)
    reasons, plain = Reasons(run), SIGNED | {"way": "plain"}
    for at_ns in range(0, 3 * NS, NS // 20):
        message = Message(at_ns, at_ns, 0.1 * (at_ns > 2 * NS), 0.0, 0, at_ns, "")
        command = sample(plain, message, PLAIN["config"], 0)
        witness.command(plain, message, command, at_ns)
        reasons.command(plain, message, command)
    assert reasons.allowed("app", 3 * NS) == set()
    reasons.dropped("cmd/app", 3 * NS)
    assert reasons.allowed("app", 3 * NS) == {"neutral"}


def test_a_port_that_is_opened_again_has_no_rest_of_a_line() -> None:
    run, line = Run(quiet_with()), b"ap0.00,bp0.00,cp0.00,dp0.00\r\n"
    began = START.mono_ns
    run._fed(began + NS, line + b"noise")
    run._fed(began + NS + 1, line)
    assert run._fed_ns == NS
    run._fed(began + 2 * NS, b"noise")
    run.product.unplug()
    run.plug(False)
    run._fed(began + 3 * NS, line)
    assert run._fed_ns == 3 * NS


@pytest.mark.slow
def test_rare_events_come_at_the_time_of_a_drive() -> None:
    counts = {"echo": 0, "block": 0}
    for seed in range(200, 400):
        plan = make_plan(seed)
        before = {key: plan[key] for key in ("board", "config")} | {"seconds": plan["seconds"]}
        drives = [[1.0, 0.0, 0.0], [5.0, 0.5, 0.0], [9.0, -0.5, 0.0]]
        sender = {"phases": drives}
        for event in _rare_events(random.Random(seed), before | {"senders": [sender]}):
            assert 1.0 <= event["at"] <= plan["seconds"]
            assert any(abs(event["at"] - time) <= 3.0 for time, *_ in drives)
            counts["block" if event["do"] == "block" else event["fault"][0]] += 1
    assert min(counts.values()) > 5


@pytest.mark.slow
def test_a_stall_in_a_step_counts_from_the_step_that_it_delays() -> None:
    stall = {"at": 2.0, "do": "stall in step", "for": 0.2}
    run = Run(quiet_with(stall))
    run.play()
    # The next line of the robot is made up to a period later.
    assert 22 * NS // 10 < run._stalled_ns < 222 * NS // 100


def state_of(counters: dict[str, int]) -> dict[str, Any]:
    return {"counters": counters}


def test_junk_that_is_counted_by_another_reason_is_a_finding() -> None:
    reports, sender = Reports(), make_plan(1)["senders"][0] | {"way": "plain", "wheels": False}
    for n, junk in enumerate(("huge", "delete", "fields")):
        message = Message(n, n, 0.1, 0.0, 0, n, junk)
        reports.command(sender, message, sample(sender, message, PLAIN["config"], 0), n, False)
    right = {"command_too_big": 1, "command_not_a_put": 1, "command_wrong_shape": 1}
    reports.judge_junk(NS, state_of(right), 0)
    reports.judge_junk(NS, state_of(right | {"command_too_big": 0}), 1)
    wrong = right | {"command_too_big": 0, "command_malformed": 1}
    with pytest.raises(BrokenError, match="counted by its reason"):
        reports.judge_junk(NS, state_of(wrong), 0)


def with_a_set_before_sigterm(settings: dict[str, float]) -> Plan:
    """Return a plan in which SIGTERM ends the daemon before it answers a `set`.

    The disk is full, so the answer waits.
    """
    call = {"verb": "set", "settings": settings, "late": 0.0, "lost": False, "twice": False}
    events: list[dict[str, Any]] = [
        {"at": 1.0, "do": "disk", "for": 0.6},
        {"at": 1.5, "do": "call", "by": "ann", "via": "native", **call},
        {"at": 1.505, "do": "restart", "way": "term", "for": 0.2},
    ]
    return quiet() | {"seconds": 3.0, "events": events}


def quiet_with(*events: dict[str, Any]) -> Plan:
    """A quiet plan of 6 s with these events."""
    return quiet() | {"seconds": 6.0, "events": list(events)}


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["before", "behind"])
def test_a_stop_that_arrives_in_the_step_that_crashes_is_latched_afterwards(moment: str) -> None:
    crash = {"do": "restart", "way": f"crash {moment} the robot", "stop": True}
    result = played(quiet_with({"at": 2.0, "for": 0.3, **crash}))
    assert result.finding == ""
    assert result.counts["mode stopped"] == 1
    assert result.counts["clear"] == 1


@pytest.mark.slow
@pytest.mark.variations(3)
@pytest.mark.parametrize("damage", ["cut", "zeros", "version"])
def test_a_robot_with_a_damaged_latch_file_starts_stopped(damage: str) -> None:
    restart = {"do": "restart", "way": "kill", "damage": damage}
    result = played(quiet_with({"at": 2.0, "for": 0.3, **restart}))
    assert result.finding == ""
    assert result.counts["mode stopped"] == 1


@pytest.mark.slow
@pytest.mark.variations(4)
@pytest.mark.parametrize("fault", [["endless"], ["wrong_baud", 9600], ["partial_line"], ["noise"]])
def test_a_board_that_cannot_be_read_loses_the_link_and_comes_back(fault: list[Any]) -> None:
    links = Counter[str]()
    run = Run(quiet_with({"at": 2.0, "for": 2.0, "do": "board", "fault": fault}))
    see = run.product._see

    def look(snapshot: StepResult) -> None:
        links[snapshot.link] += 2 < snapshot.at_ns / NS - START.mono_ns / NS < 4
        see(snapshot)

    run.product._see = look
    assert run.play()["lawful drives"] == 1
    assert links["up"] < 30 < sum(links.values())
    assert run.witness.armed_since_ns >= 4 * NS  # when the board could be read again


def test_a_request_of_ros_has_the_settings_that_the_operator_sets() -> None:
    settings = {"limits.linear_speed": 0.25, "commands.sources.app.timeout": 1.0}
    assert requested_values(parameters(settings)) == settings


@pytest.mark.parametrize("way", ["client", "signed", "header"])
@pytest.mark.parametrize("stamp_ns", BAD_STAMPS)
def test_a_command_with_a_bad_stamp_is_one_of_its_key_or_of_a_clock_that_is_not_judged(
    way: str, stamp_ns: int
) -> None:
    sender = make_plan(1)["senders"][0] | {
        "way": way,
        "source": "app",
        "churn": False,
        "wheels": False,
    }
    message = Message(NS, NS, 0.3, 0.0, stamp_ns, 1, "")
    command = sample(sender, message, PLAIN["config"], START.wall_ns)
    options = {name: value for name, value in command.options.items() if name != "put"}
    options["sender"] = options.pop("session")
    encoding, arrived_ns = options.pop("encoding", ""), START.mono_ns
    result = Receiver(JointsConfig(), Kinematics(DriveConfig())).command(
        Arrival(command.key, True, command.payload, encoding, arrived_ns, **options)
    )
    assert (result.shared, result.stamp_ns is None) == (command.shared, command.clock == "")


# the pose and the board that comes and goes


def test_a_pose_that_is_put_elsewhere_than_a_call_asked_for_is_a_finding() -> None:
    def put(pose: tuple[float, float, float]) -> None:
        witness = PoseWitness(PLAIN["config"])
        for n, where in enumerate(((0.0, 0.0, 0.0), pose)):
            at_ns = n * NS // 100
            estimate = at_ns, *where, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), ()
            witness.see(at_ns, [estimate], (at_ns, 5.0, 5.0, 0.0, 0.0), 0, set())
            if not n:
                witness.placed((2.0, -3.0, 0.5))
            witness.end_step()

    put((2.0, -3.0, 0.5))
    with pytest.raises(BrokenError, match="put where a call asks for it"):
        put((-3.0, 2.0, 0.5))


@pytest.mark.parametrize(("grown", "finding"), [(0.01, False), (0.0, True)])
def test_a_gap_while_moving_that_leaves_the_covariance_as_it_was_is_a_finding(
    grown: float, finding: bool
) -> None:
    witness = PoseWitness(PLAIN["config"])

    def see(at_s: float, x: float, true_x: float, variance: float) -> None:
        at_ns = int(at_s * NS)
        estimate = at_ns, x, 0.0, 0.0, (variance, 0.0, 0.0, variance, 0.0, 0.01), ()
        witness.see(at_ns, [estimate], (at_ns, true_x, 0.0, 0.0, 0.0), 0, set())

    for n in range(3):
        see(n * 0.01, n * 0.005, n * 0.005, 0.01)
    witness.doubt(mute=True)
    with pytest.raises(BrokenError, match="in the covariance") if finding else nullcontext():
        see(1.0, 0.01, 0.3, 0.01 + grown)


@pytest.mark.parametrize("gap_s", [0.2, 2.0])
def test_a_robot_that_stood_before_a_gap_may_have_been_pushed_in_it(gap_s: float) -> None:
    witness = PoseWitness(PLAIN["config"])

    def see(at_s: float, true_x: float) -> None:
        at_ns = int(at_s * NS)
        estimate = at_ns, 0.0, 0.0, 0.0, (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4), ()
        witness.see(at_ns, [estimate], (at_ns, true_x, 0.0, 0.0, 0.0), 0, set())

    for n in range(30):
        see(1.0 + n * 0.01, 0.0)
    outcome = nullcontext() if gap_s > 1.0 else pytest.raises(BrokenError, match="its covariance")
    with outcome:
        for n in range(30):
            see(1.3 + gap_s + n * 0.01, 2.0)


@pytest.mark.parametrize(("since_s", "finding"), [(0.5, False), (2.5, True)])
def test_lines_that_waited_at_a_wrong_baud_rate_tell_an_older_motion(
    since_s: float, finding: bool
) -> None:
    witness = PoseWitness(PLAIN["config"])
    witness.mended("wrong_baud", 0)
    with pytest.raises(BrokenError, match="its covariance") if finding else nullcontext():
        for n in range(300):
            at_ns = int(since_s * NS) + n * NS // 250
            estimate = at_ns, 0.0, 0.0, 0.0, (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4), ()
            witness.see(at_ns, [estimate], (at_ns, n * 0.002, 0.0, 0.0, 0.0), 0, set())


def test_a_pose_in_state_that_moves_while_the_board_is_silent_is_a_finding() -> None:
    state = {"x": 1.0, "y": 2.0, "yaw": 0.5}
    judge_pose(2 * NS, state, (1.0, 2.0, 0.5), NS, NS // 10)
    judge_pose(2 * NS, state, (0.9, 2.0, 0.5), 2 * NS - NS // 20, NS // 10)
    with pytest.raises(BrokenError, match="the pose of a silent board stays"):
        judge_pose(2 * NS, state, (0.9, 2.0, 0.5), NS, NS // 10)


class Board(NamedTuple):
    """The facts about the board that the judge of plugging uses."""

    plugged: bool
    unplugged_ns: int = 0
    plugged_ns: int = 0


@pytest.mark.parametrize(
    ("link", "after_ms", "line", "promise"),
    [
        ("up", 29, None, ""),
        ("up", 31, None, "an unplugged board is seen"),
        ("down", 9000, None, ""),
        ("stale", 499, b"", ""),
        ("up", 41, b"", "a linked board gets a line in each period"),
        ("up", 39, b"", ""),
        ("stale", 531, b"", "a board that is plugged in gets a line"),
        ("stale", 501, b"ap00.00,bp00.00,cp00.00,dp00.00\r\n", ""),
        ("stale", 9, b"ap00.00,bp00.01,cp00.01,dp00.00\r\n", "the first line is a zero"),
    ],
)
def test_the_judge_sees_a_board_that_comes_and_goes(
    link: str, after_ms: int, line: bytes | None, promise: str
) -> None:
    at_ns = after_ms * NS // 1000
    lines = [(at_ns, line)] if line else []
    snapshot = result(at_ns, "waiting", link=link, lines=lines)
    board: Any = Board(line is not None)
    judged = pytest.raises(BrokenError, match=promise) if promise else nullcontext()
    with judged:
        Plugging(NS // 100).see(at_ns, snapshot, board, 0)


@pytest.mark.parametrize(("lost", "finding"), [(2, False), (3, True)])
def test_whole_lines_that_are_not_heard_behind_a_damaged_one_are_a_finding(
    lost: int, finding: bool
) -> None:
    damage, whole = Damage(), b"ap00.10,bp00.10,cp00.10,dp00.10\r\n"
    damage.fed(whole + whole[9:])
    with pytest.raises(BrokenError, match="are heard behind") if finding else nullcontext():
        for n in range(1, 9):
            damage.fed(whole[:7])
            damage.fed(whole[7:])
            damage.judge(n * NS, lambda n=n: max(0, n - lost))  # type: ignore[misc]


@pytest.mark.parametrize("stalled", [True, False])
def test_a_step_that_stalls_leaves_whole_lines_to_the_next_step(stalled: bool) -> None:
    damage, whole = Damage(), b"ap00.10,bp00.10,cp00.10,dp00.10\r\n"
    damage.fed(whole + whole[9:] + 2 * whole)
    damage.judge(NS, lambda: 2)
    damage.fed(4 * whole)
    damage.judge(2 * NS, lambda: 5, stalled)
    with nullcontext() if stalled else pytest.raises(BrokenError, match="are heard behind"):
        damage.judge(3 * NS, lambda: 5, stalled)
    if stalled:
        damage.judge(4 * NS, lambda: 6)


SIGNED = make_plan(1)["senders"][0] | {
    "way": "signed", "source": "app", "wheels": False, "delay": 0.0, "churn": False,
    "jitter": 0.0, "congestion": [], "clock": [], "bursts": [], "bad_stamps": 0.0, "junk": 0.0,
    "ahead": 0.0, "drift": 0.0, "loss": 0.0, "twice": 0.0, "swap": 0.0,
}  # fmt: skip


def followed_in_turn(*sent: tuple[float, str]) -> None:
    """Let the judge see commands, each followed by the robot: arrival, s, and sender."""
    witness = witnessed()
    followed = Followed(witness)
    for number, (at_s, name) in enumerate(sent):
        sender, at_ns = SIGNED | {"id": name}, int(at_s * NS)
        message = Message(at_ns, at_ns, 0.3, 0.0, at_ns, number, "")
        command = sample(sender, message, PLAIN["config"], 0)
        wish = witness.command(sender, message, command, at_ns)
        followed.command(sender, message, command, at_ns, wish)
        followed.step(at_ns + 1, at_ns + 1, at_ns, "driving", "up")


def test_a_second_sender_that_is_followed_before_the_first_is_silent_is_a_finding() -> None:
    followed_in_turn((4.0, "a"), (6.0, "b"))
    with pytest.raises(BrokenError, match="the first of equal priority keeps the robot"):
        followed_in_turn((4.0, "a"), (4.05, "b"))


@pytest.mark.parametrize(("source", "way", "finding"), [
    ("teleop", "plain", False), ("teleop", "signed", True), ("nav", "plain", True),
])  # fmt: skip
def test_a_command_of_higher_priority_may_end_the_place_of_the_first_sender(
    source: str, way: str, finding: bool
) -> None:
    witness = witnessed()
    witness.priority |= {"app": 50, "teleop": 100, "nav": 10}
    witness.timeout |= dict.fromkeys(("app", "teleop", "nav"), NS // 2)
    followed = Followed(witness)
    expected = pytest.raises(BrokenError, match="first of equal") if finding else nullcontext()
    with expected:
        for number, (at_ns, name) in enumerate(
            [(4 * NS, "a"), (4 * NS + NS // 20, source), (4 * NS + NS // 10, "b")]
        ):
            sender = SIGNED | {"id": name}
            if name == source:
                sender |= {"source": source, "way": way}
            message = Message(at_ns, at_ns, 0.3, 0.0, at_ns, number, "")
            command = sample(sender, message, PLAIN["config"], 0)
            wish = witness.command(sender, message, command, at_ns)
            followed.command(sender, message, command, at_ns, wish)
            followed_ns = None if name == source else at_ns
            witness.read()
            followed.step(at_ns + 1, at_ns + 1, followed_ns, "driving", "up")


@pytest.mark.parametrize("released", [True, False])
def test_a_robot_that_is_released_forgets_the_command_that_it_followed_in_that_step(
    released: bool,
) -> None:
    witness = witnessed()
    followed = Followed(witness)
    expected = nullcontext() if released else pytest.raises(BrokenError, match="first of equal")
    with expected:
        for number, name in enumerate("ab"):
            at_ns, sender = 4 * NS + number * NS // 20, SIGNED | {"id": name}
            message = Message(at_ns, at_ns, 0.3, 0.0, at_ns, number, "")
            command = sample(sender, message, PLAIN["config"], 0)
            wish = witness.command(sender, message, command, at_ns)
            followed.command(sender, message, command, at_ns, wish)
            if released and not number:
                witness.arming(at_ns + 1)
            followed.step(at_ns + 2, at_ns + 2, at_ns, "driving", "up")


def test_a_clock_whose_delay_falls_has_no_certain_command_any_more() -> None:
    witness = witnessed()
    followed, sender = Followed(witness), SIGNED | {"way": "client", "delay": 1.0}

    def arrives(at_ns: int, delay_ns: int) -> None:
        message = Message(at_ns - delay_ns, at_ns, 0.3, 0.0, at_ns - delay_ns, at_ns, "")
        command = sample(sender, message, PLAIN["config"], 0)
        wish = witness.command(sender, message, command, at_ns)
        followed.command(sender, message, command, at_ns, wish)

    for at_ns in range(NS, 8 * NS, NS // 20):
        arrives(at_ns, NS)
        followed.step(at_ns + 1, at_ns + 1, None, "driving", "up")
    assert followed._sure
    arrives(8 * NS, NS)
    assert followed._waiting
    arrives(8 * NS + 1, NS // 2)
    assert not followed._sure
    assert not followed._waiting


@pytest.mark.parametrize("number", [200, 202])
def test_a_command_older_than_one_without_motion_is_not_certain(number: int) -> None:
    followed, sender = Followed(witnessed()), SIGNED | {"way": "client"}
    for at_ns, sequence, junk in (
        *((n * NS // 20, n, "") for n in range(20, 200)),
        (10 * NS, 201, "cancels"),
        (10 * NS + 1, number, ""),
    ):
        message = Message(at_ns, at_ns, 0.3, 0.0, at_ns, sequence, junk)
        command = sample(sender, message, PLAIN["config"], 0)
        wish = followed._witness.command(sender, message, command, at_ns)
        followed.step(at_ns, at_ns, None, "driving", "up")
        followed.command(sender, message, command, at_ns, wish)
    assert bool(followed._waiting) is (number > 201)


def test_a_slope_that_grows_faster_than_the_jerk_is_seen_through_the_rounding() -> None:
    for jerk, allowed in ((2.0, True), (6.0, False)):
        slope, plausible = Slope(), True
        for n in range(30):
            speed = round(jerk * (n * 0.01) ** 2 / 2 / 0.0005) * 0.0005
            plausible = slope.take(speed, 0.01, 2.0, 4.0, 0.00026) and plausible
        assert plausible is allowed


# shrinking


@pytest.mark.slow
def test_shrinking_leaves_what_the_finding_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(plan: Plan) -> Result:
        verbs = [event.get("verb") for event in plan["events"]]
        fails = "clear" in verbs and any(s["phases"] for s in plan["senders"])
        name = "a made-up promise" if fails else ""
        return Result(1, name, name, int(500 * NS), 1.0, 0.1, Counter())

    monkeypatch.setattr(shrink, "played", broken)
    dice = random.Random(1)
    large = next(
        p for p in map(make_plan, range(99)) if any(e.get("verb") == "clear" for e in p["events"])
    )
    dice.shuffle(large["events"])
    small = shrink.shrunk(large, broken(large))
    assert [event.get("verb") for event in small["events"]] == ["clear"]
    assert [len(sender["phases"]) for sender in small["senders"]] == [1]
    assert not problems(small["config"])


# pairs


def copy_of_the_package(where: Path) -> Path:
    """Copy the package alone to another directory, like an installed wheel.

    The copy includes the compiled modules, because compiling takes longer than the plan.
    """
    shutil.copytree(OURS / "acsard", where / "acsard")
    return where


@pytest.mark.slow
def test_a_paired_run_finds_no_difference_to_the_same_code_and_names_the_first_one_else(
    tmp_path: Path,
) -> None:
    other = copy_of_the_package(tmp_path)
    plan = quiet()
    pair = Pair(OURS, other)
    assert pair.sides[1].package.is_relative_to(tmp_path)
    assert pair.differs(plan)[0] == ""
    pair.close()
    words = other / "acsard" / "core" / "codes.py"
    text = words.read_text(encoding="utf-8")
    words.write_text(text.replace("waiting for a command", "no command"), encoding="utf-8")
    pair = Pair(OURS, other)
    difference, _ = pair.differs(plan)
    pair.close()
    assert "reason: here 'waiting for a command" in difference
    assert "there 'no command" in difference


def test_an_event_that_is_left_out_of_pairs_is_in_no_plan_of_theirs() -> None:
    plan = next(
        p for p in map(make_plan, range(99)) if any(e["do"] == "restart" for e in p["events"])
    )
    less = pairs.comparable(plan, (("do", "restart", "it restarts in another way"),))
    assert {event["do"] for event in plan["events"]} - {
        event["do"] for event in less["events"]
    } == {"restart"}


def test_a_pair_goes_on_behind_a_broken_promise_and_ends_at_an_exception_of_the_product(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(self: Witness, *_: object) -> None:
        raise BrokenError("a made-up promise", 0, "")

    monkeypatch.setattr(Witness, "step", broken)
    assert "a made-up promise" in played(quiet()).finding
    trace = Trace()
    assert Unjudged(quiet(), trace.step).played() == ""
    # The last step is in the second in which the plan ends.
    assert len(trace.hashes) == START.mono_ns // NS + quiet()["seconds"] + 1

    def fails(self: Run, true_ns: int) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(Run, "run_to", fails)
    assert Unjudged(quiet()).played() == "ZeroDivisionError: division by zero"


def test_a_pair_does_not_measure_the_memory_of_a_daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    # An older checkout measures it in another way.
    monkeypatch.delattr(Product, "largest")
    endless = {"at": 2.0, "for": 1.0, "do": "board", "fault": ["endless"]}
    assert Unjudged(quiet_with(endless)).played() == ""


def test_a_listed_difference_is_taken_out_on_both_sides() -> None:
    listed = (("reason", "no command|waiting for a command", "X", "new words"),)
    steps = [
        pairs.rewritten({"at": 1, "reason": words}, listed)
        for words in ("waiting for a command: now", "no command: now")
    ]
    assert steps[0] == steps[1] == {"at": 1, "reason": "X: now"}


@cache
def plans_of_moments() -> dict[str, Plan]:
    """Return, for each moment of `bad_moments.py`, the first plan that has it."""
    plans: dict[str, Plan] = {}
    for plan in map(make_plan, range(2000)):
        plans.setdefault(plan.get("moment", ""), plan)
        if plans.keys() >= MOMENTS.keys():
            break
    return plans


@pytest.mark.slow
@pytest.mark.parametrize("name", MOMENTS)
def test_a_plan_with_a_moment_is_legal_and_an_older_product_knows_its_faults(name: str) -> None:
    plan = plans_of_moments()[name]
    assert problems(plan["config"]) == []
    assert plan == json.loads(json.dumps(plan))
    less = pairs.comparable(plan)
    names = {event.get("fault", [event["do"]])[0] for event in less["events"]}
    assert not (names | {fault[0] for fault in less["board"]}) & NEW


def test_an_echo_beside_a_board_is_a_finding_only_if_the_pose_is_wrong_for_long() -> None:
    judge = HalfDuplex()
    judge.begin()
    judge.see(0, "driving", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for n in range(55):
        speed = max(0, n - 5) / 5
        judge.line(n * NS // 20, (speed, speed, speed, speed))
    judge.see(NS, "driving", (1.0, 0.0, 0.0), (0.6, 0.0, 0.0))
    judge.see(2 * NS, "waiting", (2.0, 0.0, 0.0), (1.2, 0.0, 0.0))
    with pytest.raises(BrokenError, match="an echo beside a board is seen"):
        judge.see(3 * NS, "driving", (2.1, 0.0, 0.0), (1.2, 0.0, 0.0))


@pytest.mark.parametrize(("yaw", "finding"), [(0.0, False), (0.5, True)])
def test_a_heading_that_jumps_while_the_robot_stands_is_a_finding(
    yaw: float, finding: bool
) -> None:
    pose = PoseWitness(PLAIN["config"])
    small = (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
    for n, at_ns in enumerate((0, 10_000_000, 20_000_000, 500_000_000)):
        estimate = (at_ns, 0.0, 0.0, yaw * (n == 3), small, ())
        judged = pytest.raises(BrokenError, match="stands keeps its heading")
        with judged if finding and n == 3 else nullcontext():
            pose.see(at_ns, [estimate], (at_ns, 0.0, 0.0, 0.0, 0.0), 0, set())


def test_a_reason_without_the_client_that_stopped_the_robot_is_a_finding() -> None:
    witness = Witness(PLAIN["config"])
    inputs = Inputs(witness, reports=True)
    step = result(0, "stopped", "stopped by op1 (native)")
    witness.stops = [0]
    inputs.note_stop(0, "op1")
    inputs.step(1, step, 0, True, dict)
    pressed = result(2, "stopped", "front bumper pressed")
    with pytest.raises(BrokenError, match="a stop keeps the name of its client"):
        inputs.step(2, pressed, 0, True, dict)


@pytest.mark.parametrize(("clients", "daemon", "finding"), [
    (30, False, True), (31, False, False), (30, True, False),
])  # fmt: skip
def test_a_reason_may_leave_out_a_client_only_if_it_names_31_others(
    clients: int, daemon: bool, finding: bool
) -> None:
    witness = Witness(PLAIN["config"])
    inputs = Inputs(witness, reports=True)
    witness.stops = [0]
    inputs.note_stop(0, "op1")
    causes = [f"was stopped by client {n}, before the restart" for n in range(clients)]
    causes += ["stopped when the daemon started, because the disk is full"] * daemon
    reason = "; also ".join(["front bumper pressed", *causes])
    expected = pytest.raises(BrokenError, match="keeps the name") if finding else nullcontext()
    with expected:
        inputs.step(1, result(0, "stopped", reason), 0, True, dict)
