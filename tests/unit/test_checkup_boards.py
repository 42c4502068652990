"""The check of boards with and without faults: each fault is named with its remedy, nothing else.

The approved texts have what the check says about each board, without what it says about the first
board of the page too: equal findings and, except on the page of good boards, passed steps.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

from acsard.checkup import inputs, procedure
from acsard.checkup.findings import Finding, motor_name
from acsard.core.config.motion_rules import top_wheel_speed
from acsard.core.config.settings import (
    Config,
    FeedbackConfig,
    McuConfig,
    Place,
    SafetyConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.simulator import protocol
from acsard.core.values import NS_PER_S
from tests.each import each
from tests.unit.checkup_robots import FOUR_AND_TWO, Checked, Nobody, Person, Robot
from tests.unit.checkup_robots import TWO as TWO_WHEELS

WORDS = Path(__file__).with_name("words")

SPEED = re.compile(rb"[a-z][pn](\d\d\.\d\d)")
COARSE = Config(sim=SimConfig(encoder_counts=16))
HEAVY = Config(sim=SimConfig(motor_time_constant=1.0))
WIRED = Config(mcu=McuConfig(wheels=WheelMap("-c", "+d", "-a", "+b")))


def at_baud(rate: Any) -> Config:
    return Config(mcu=McuConfig(baud_rate=rate))


# The board of the course robot, as `howto/course-robot.md` configures it.
COURSE = Config(mcu=structs.replace(TWO_WHEELS.mcu, trailing_comma=True, reply_period=0.1))


SKETCH = Config(mcu=McuConfig(wheels=WheelMap(right="+a", left="+b")))


def with_lag(seconds: float) -> Config:
    return structs.replace(COURSE, sim=SimConfig(motor_time_constant=seconds))


# Maps the pages to boards: the faults, the settings of the host, and whether a person watches.
# Without a person the check names both parts that may be at fault.
BOARDS: dict[str, dict[str, tuple[str, dict[str, Any], bool]]] = {
    "good": {
        "plain": ("plain_only", {}, False),
        "checked, in use": ("no_sample", {"link_check": "on"}, False),
        "counts, in use": ("", {"link_check": "on", "encoder_counts": 3200}, False),
        "counts, not in use": ("", {}, False),
        "an old sketch": ("free_running plain_only", {"reply_period": 0.1}, False),
        "a comma": ("", {"trailing_comma": True}, False),
        "status lines": ("plain_only estop", {}, False),
    },
    "hardware": {
        "plain": ("plain_only", {}, False),
        "with a person": ("plain_only", {}, True),
        "9600 baud": ("", {"config": at_baud(9600)}, False),
        "heavy wheels": ("plain_only", {"config": HEAVY}, False),
        "coarse encoders": ("plain_only", {"config": COARSE}, True),
    },
    "lines": {
        "plain": ("plain_only", {}, False),
        "silent": ("mute", {}, False),
        "noise": ("noise", {}, False),
        "pieces": ("partial_line", {}, False),
        "another rate": ("plain_only", {"config": at_baud(57600), "baud_rate": 115200}, False),
        "seldom": ("plain_only sparse_replies", {}, False),
        "10 Hz by itself": ("plain_only free_running", {}, False),
        "spaces": ("plain_only spaces", {}, False),
        "unpadded": ("plain_only unpadded", {}, False),
        "slow": ("plain_only slow_reply", {}, False),
    },
    "losses": {
        "plain": ("plain_only", {}, False),
        "lost replies": ("lost_replies", {}, False),
        "lost commands": ("lost_commands plain_only", {}, False),
        "bit errors": ("bit_errors", {}, False),
        "a silence": ("plain_only stalls=1:0.2", {}, False),
        "no check, wanted": ("plain_only", {"link_check": "on"}, False),
        "an old check, wanted": ("no_check", {"link_check": "on"}, False),
    },
    "motors": {
        "plain": ("plain_only", {}, False),
        **{part: (f"plain_only {part}", {}, False)
           for part in ["reversed_motor=c", "stuck_encoder=b", "dead_motor=d",
                        "swapped_motors=a:b", "bias=c:0.93", "bias=c:0.7", "bias=b:3"]},
        "no supply": (" ".join(["plain_only", *(f"dead_motor={m}" for m in "abcd")]), {}, False),
        "two dead": ("plain_only dead_motor=a dead_motor=c", {}, False),
    },
    "motors_seen": {
        "plain": ("plain_only", {}, True),
        **{part: (f"plain_only {part}", {}, True)
           for part in ["reversed_motor=c", "reversed_encoder=b", "dead_motor=d",
                        "stuck_encoder=a", "reversed_wheel=a", "swapped_wheels=b:d",
                        "swapped_motors=a:b", "swapped_encoders=c:d"]},
        "any wiring": ("plain_only", {"config": WIRED, "wheels": WheelMap()}, True),
    },
    "two_wheels": {
        "plain": ("plain_only", {"config": TWO_WHEELS}, True),
        **{part: (part, {"config": TWO_WHEELS}, True)
           for part in ["comma_latched", "no_watchdog", "watchdog_fed_by_bad_lines",
                        "dead_motor=r", "swapped_encoders=l:r", "reversed_wheel=l"]},
        "counts, in use": (
            "", {"config": TWO_WHEELS, "link_check": "on", "encoder_counts": 3200}, False),
        "any wiring": ("", {"config": TWO_WHEELS, "wheels": WheelMap(left="-r", right="+l")}, True),
        "other letters": ("free_running", {"config": TWO_WHEELS, "wheels": WheelMap()}, False),
        "letters of four": (
            "free_running", {"wheels": TWO_WHEELS.mcu.wheels}, False),
        "lines of two": ("no_check", {"config": SKETCH, "wheels": WheelMap("-a")}, True),
        "lines of two at another rate": (
            "wrong_baud=57600", {"config": SKETCH, "wheels": WheelMap()}, True),
        "lines of four": ("", {"wheels": SKETCH.mcu.wheels}, True),
    },
    "course": {
        "plain": ("free_running plain_only", {"config": COURSE}, True),
        **{part: (f"free_running comma_latched {part}", {"config": COURSE}, True)
           for part in ["last_edge", "toggled_direction", "no_watchdog",
                        "last_edge toggled_direction no_watchdog"]},
        "quick motors": ("free_running plain_only", {"config": with_lag(0.03)}, True),
        "slow motors": ("free_running plain_only", {"config": with_lag(0.2)}, True),
    },
    "firmware": {
        "plain": ("plain_only", {}, False),
        "no watchdog": ("plain_only no_watchdog", {}, False),
        "a late watchdog": ("plain_only late_watchdog", {}, False),
        "a watchdog that damaged lines feed": ("plain_only watchdog_fed_by_bad_lines", {}, False),
        "a comma is needed": ("comma_latched", {}, False),
        "a comma is needed, and configured": ("comma_latched", {"trailing_comma": True}, False),
        "an old check": ("no_check", {}, False),
        "wrong counts configured": ("", {"link_check": "on", "encoder_counts": 1600}, False),
        "coarse encoders": ("", {"config": COARSE}, False),
        "all at once": ("comma_latched wrong_baud=57600 reversed_motor=a stuck_encoder=b spaces "
                        "no_watchdog reversed_wheel=c", {}, True),
    },
}  # fmt: skip

Habit = Callable[[bytes, bytes, int], bytes]
"""Returns what the board sends for the last command, the usual reply, and the reply's number."""

TEXT = b"[I][main] loop ok, heap 182344\r\n"

HABITS: dict[str, Habit] = {
    "plain": lambda _, reply, n: reply,
    "LF CR": lambda _, reply, n: reply[:-2] + b"\n\r",
    "figures with spaces": lambda _, reply, n: re.sub(rb"([pn])0", rb"\1 ", reply),
    "text each second": lambda _, reply, n: (b"" if n % 50 else TEXT) + reply,
    "text before each reply": lambda _, reply, n: TEXT + reply,
    "only text": lambda _, reply, n: TEXT,
    "an echo before the reply": lambda command, reply, n: command + reply,
    "set points": lambda command, reply, n: command,
    "set points, as configured": lambda command, reply, n: command,
    "no direction": lambda _, reply, n: reply.replace(b"n", b"p"),
}
BOARDS["habits"] = {name: ("plain_only", {}, False) for name in HABITS}
NO_ENCODERS = Config(feedback=FeedbackConfig(encoders=False))
BOARDS["habits"]["set points, as configured"] = ("plain_only", {"config": NO_ENCODERS}, False)


class Hobby(Robot):
    """A robot whose firmware has a habit of hobbyists."""

    def __init__(self, habit: Habit, *faults: str, **how: Any) -> None:
        super().__init__(*faults, **how)
        self._habit, self._command, self._held, self._replies = habit, b"", b"", 0

    def send(self, data: bytes) -> None:
        super().send(data)
        commands = [line for line in data.splitlines(keepends=True) if SPEED.match(line)]
        if commands:
            self._command = commands[-1].strip().partition(b"#")[0] + b"\r\n"

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        pieces = []
        for at_ns, data in super().listen(until_ns):
            *replies, self._held = (self._held + data).split(b"\r\n")
            for reply in replies:
                pieces.append((at_ns, self._habit(self._command, reply + b"\r\n", self._replies)))
                self._replies += 1
        return pieces


def lines(finding: Finding) -> Iterator[str]:
    yield f"{finding.verdict:8}{finding.name} | {finding.figure}"
    if finding.verdict != "PASS":
        yield f"        {finding.text}"
    if finding.mend:
        yield f"        -> {finding.mend}"


DAILY = ("motors", "hardware", "two_wheels", "course")


def robots(page: str) -> Iterator[tuple[str, Robot, bool]]:
    """Yield the boards of a page: name, robot, and whether a person watches."""
    for name, (faults, how, person) in BOARDS[page].items():
        habit = HABITS[name] if page == "habits" else None
        robot = Hobby(habit, *faults.split(), **how) if habit else Robot(*faults.split(), **how)
        yield name, robot, person


class Page:
    """The text of a page, board by board."""

    def __init__(self, page: str) -> None:
        self._passes = page in ("good", "hardware")
        self._first, self._passed = list[Finding](), set[str]()

    def new(self, findings: list[Finding]) -> list[str]:
        """Return what the page says about the next board."""
        text = list[str]()
        for finding in findings:
            passed = finding.verdict == "PASS" and finding.name in self._passed
            if not (finding in self._first or passed):
                text += lines(finding)
        if not self._first:
            self._first = findings
            if not self._passes:
                self._passed = {found.name for found in findings if found.verdict == "PASS"}
        return text


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=() if page in DAILY else pytest.mark.slow) for page in BOARDS],
)
def test_the_check_names_each_fault_and_nothing_else(
    page: str, approved: Callable[[Path, str], None]
) -> None:
    text, says = "", Page(page)
    for name, robot, person in robots(page):
        checked = Checked(robot, person)
        assert not checked.left_turning
        sent = [line for line in robot.sent if b"x" not in line]
        top = max(3.0, top_wheel_speed(robot.config))
        assert max(float(speed) for line in sent for speed in SPEED.findall(line)) <= top
        text += "".join(f"{line}\n" for line in (f"== {name}", *says.new(checked.findings)))
        text += "".join(f"        {key} = {value!r}\n" for key, value in checked.changes.items())
    approved(WORDS / f"checkup_{page}.txt", text)


GOOD = re.compile(rb"([a-z][pn]\d\d\.\d\d,?)+#?\r\n")


def sent_to(robot: Robot) -> str:
    """Return what the board got, a row for equal lines or for a ramp: time, number and lines."""
    lines = (re.sub(rb"#\S+", b"#", line) for line in robot.sent)  # without number and checksum
    series = [
        [*same] for _, same in groupby(zip(robot.sent_s, lines, strict=True), key=itemgetter(1))
    ]
    text = ""
    for ramp, parts in groupby(
        series, key=lambda same: len(same) == 1 and bool(GOOD.fullmatch(same[0][1]))
    ):
        rows = [*parts]
        for row in [[one for same in rows for one in same]] if ramp else rows:
            (at_s, first), (_, last) = row[0], row[-1]
            until = f" to {last!r}" if last != first else ""
            text += f"{at_s:7.2f} {len(row):4} {first!r}{until}\n"
    return text


@each(
    ("name", "faults", "how"),
    [("plain", ["plain_only"], {"config": TWO_WHEELS}), ("checked", [], {"encoder_counts": 3200})],
)
def test_the_check_sends_the_lines_that_a_person_has_read(
    name: str, faults: list[str], how: dict[str, Any], approved: Callable[[Path, str], None]
) -> None:
    robot = Robot(*faults, **how)
    Checked(robot)
    approved(WORDS / f"checkup_sent_{name}.txt", sent_to(robot))


class Leaves(Nobody):
    """An operator who ends the check when the first motor shall turn."""

    def doing(self, text: str) -> None:
        if "turns: briefly" in text:
            raise KeyboardInterrupt


@pytest.mark.parametrize("page", ["good", "lines", "losses", "habits", "firmware"])
def test_the_steps_in_which_no_motor_turns_say_what_the_whole_check_says(page: str) -> None:
    """The whole checks of these boards are slow."""
    steps = procedure.STEPS[: procedure.STEPS.index("motors")]
    texts = (WORDS / f"checkup_{page}.txt").read_text(encoding="utf-8").split("== ")[1:]
    says = Page(page)
    for (name, robot, _), text in zip(robots(page), texts, strict=True):
        findings = list[Finding]()
        with robot.faulty(), suppress(KeyboardInterrupt):
            procedure.run(robot, Leaves(), robot.config, findings.append, fast=True)
        assert {float(speed) for line in robot.sent for speed in SPEED.findall(line)} == {0.0}
        # A finding has indented lines, and at the end of the board are the changes.
        entries = re.split(r"\n(?! )", re.sub(r"\n +\w+\.\w+ = .*", "", text).rstrip())
        told = [entry for entry in entries[1:] if entry[8:].startswith(steps)]
        silent = [finding for finding in findings if finding.name in steps]
        assert says.new(silent) == "\n".join(told).splitlines(), name


@FOUR_AND_TWO
def test_an_encoder_that_moves_while_no_wheel_turns_fails_its_motor(config: Config) -> None:
    robot, motor = Robot("plain_only", config=config), f"motor {config.mcu.wheels.letters[1]}"

    class Watching(Person):
        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            answer = super().ask(question, answers)
            return "none" if f"did {motor} turn" in question else answer

    checked = Checked(robot, Watching(robot))
    assert checked.failed == [motor_name(config.mcu, 1)]
    assert "you saw no wheel turn" in checked[motor].text


class Coupled(Robot):
    """A robot whose firmware turns the motors of each of these groups with their mean speed."""

    def __init__(self, groups: Sequence[Sequence[int]], *faults: str, config: Config) -> None:
        super().__init__(*faults, config=config)

        def understand(line: bytes) -> protocol.BoardCommand | None:
            command = protocol.reference(line, self.mcu.letters)
            values = command.values if command else {}
            for group in groups if values else ():
                mean = sum(values[motor] for motor in group) / len(group)
                values.update(dict.fromkeys(group, mean))
            return command

        vars(self.mcu)["understand"] = understand


@pytest.mark.variations(3)
@FOUR_AND_TWO
@pytest.mark.parametrize(("fault", "verdict"), [((), "PASS"), (("no_watchdog",), "FAIL")])
def test_coupled_motors_show_the_watchdog_too(
    fault: tuple[str, ...], verdict: str, config: Config
) -> None:
    groups = [(0, 3), (1, 2)] if config == Config() else [(0, 1)]
    checked = Checked(Coupled(groups, *fault, config=config))
    assert checked.failed[:1] == [motor_name(config.mcu, 0)]
    assert "are wheels coupled" in checked[motor_name(config.mcu, 0)].mend
    assert [checked[row].verdict for row in ("watchdog", "damaged lines")] == [verdict, "PASS"]
    assert not checked.left_turning


def test_an_echo_is_not_taken_for_a_robot() -> None:
    class Echo(Robot):
        echo = b""

        def send(self, data: bytes) -> None:
            self.sent.append(data)
            self.echo += data

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            data, self.echo = self.echo, b""
            super().listen(until_ns)
            return [(self.now_ns(), data)] if data else []

    checked = Checked(Echo())
    assert checked.failed == ["identification"]
    assert checked["identification"].figure == "an echo"


@each("comma", [False, True])
def test_if_one_form_of_line_is_not_answered_the_other_form_is_used(comma: bool) -> None:
    class Particular(Robot):
        """A robot that accepts lines only with a final comma, or only without one."""

        def send(self, data: bytes) -> None:
            taken = [s for s in data.splitlines(keepends=True) if s.endswith(b",\r\n") == comma]
            super().send(b"".join(taken))

    checked = Checked(Particular("plain_only", trailing_comma=not comma))
    assert checked.failed == ["trailing comma"]
    assert checked.changes == {"mcu.trailing_comma": comma}
    assert checked["reply rate"].verdict == checked["round trip"].verdict == "PASS"


def test_firmware_that_refuses_plain_lines_is_checked_to_the_end() -> None:
    class Refuses(Robot):
        def send(self, data: bytes) -> None:
            taken = [s for s in data.splitlines(keepends=True) if b"p" not in s or b"#" in s]
            super().send(b"".join(taken))

    assert Checked(Refuses()).failed == []


def test_the_check_waits_for_a_board_that_boots_when_the_port_opens() -> None:
    robot = Robot()
    robot.mcu.reset(0, 2 * NS_PER_S)
    assert Checked(robot).failed == []


# The inputs of a board, which a person presses.

ALL = {"emergency stop": 0, "front bumper": 1, "rear bumper": 2}
FRONTS: tuple[Place, ...] = ("front", "front", "front")
TWO = SafetyConfig(bumpers=("front", "rear"))
BOTH = SafetyConfig(estop="required", bumpers=("front", "rear"))
SAME = SafetyConfig(bumpers=("front", "front"))
OFF = SafetyConfig(estop="off", bumpers=("front", "rear"), bumper="off")


PRESSED: dict[str, tuple[str, SafetyConfig, int, dict[str, int] | None]] = {
    "no inputs": ("", SafetyConfig(), 2, {}),
    "all": ("estop bumpers", BOTH, 2, ALL),
    "a stop that is not configured": ("estop", SafetyConfig(), 2, ALL),
    "not configured": ("bumpers", SafetyConfig(), 2, {"bumper 1": 1, "bumper 2": 2}),
    "two at one place": ("bumpers", SAME, 2, {"front bumper (1)": 1, "front bumper (2)": 2}),
    "switched off": ("estop bumpers", OFF, 2, ALL),
    "nobody presses": ("estop bumpers", BOTH, 2, None),
    "no bumpers reported": ("estop", BOTH, 2, ALL),
    "no stop reported": ("bumpers", BOTH, 2, ALL),
    "three bumpers reported": ("estop bumpers", BOTH, 3, ALL),
    "swapped": ("bumpers", TWO, 2, {"front bumper": 2, "rear bumper": 1}),
    "swapped, not configured": ("bumpers", SafetyConfig(), 2, {"bumper 1": 2, "bumper 2": 2}),
    "one is dead": ("bumpers", TWO, 2, {"front bumper": 1}),
    "one stays pressed": ("bumper_pressed=2:0:0", TWO, 2, {"front bumper": 1, "rear bumper": 2}),
}  # fmt: skip


def test_each_input_is_pressed_and_named_if_it_is_wrong(
    approved: Callable[[Path, str], None],
) -> None:
    text = ""
    for name, (faults, safety, reports, presses) in PRESSED.items():
        built = SafetyConfig(bumpers=FRONTS[:reports])
        robot = Robot(*faults.split(), config=Config(safety=built))
        operator: Any = Nobody()
        if presses is not None:
            operator = Person(robot)
            operator.presses = presses
        with robot.board() as board:
            board.listen(0.5)
            finding = inputs.finding(board, operator, safety)
        text += "\n".join([f"== {name}", *lines(finding), ""])
    approved(WORDS / "checkup_inputs.txt", text)
