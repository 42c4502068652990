"""Tests of robot and guard under any order of events, connected as in the control loop.

Hypothesis chooses the events. The test keeps its own record of which senders have sent a zero,
which command is fresh, which lines were good, and which lines were sent to the motors. It shares
only the configuration with the robot. After every step it compares the outputs with its record.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import get_args

import msgspec
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)

from acsard.core.codes import AgeCode
from acsard.core.config.settings import (
    CommandsConfig,
    Config,
    ControlConfig,
    LimitsConfig,
    McuConfig,
    Source,
)
from acsard.core.guard import Guard
from acsard.core.link.feedback import MAX_FILLED_GAP_S
from acsard.core.motion.arbiter_text import waiting
from acsard.core.robot import Robot
from acsard.core.values import (
    NS_PER_S,
    REST,
    Answer,
    Cause,
    Command,
    Echo,
    Instant,
    Latches,
    Plain,
    Pose,
    Received,
    Request,
    Trip,
    Twist,
    Verb,
)
from tests.stepped import Inputs, Outputs, SteppedRobot
from tests.unit.core.guarded import checked

MS = 1_000_000
WALL_NS = 1_800_000_000 * NS_PER_S
ROUNDING = 0.006
LEFT_OUT_S = 0.3
"""Longest time of the evidence that leaves a wheel out."""
"""Largest rounding error of a line, rad/s, because a line has two decimals."""

SOURCES = (
    Source("teleop", 100),
    Source("app", 50),
    Source("twin", 50, timeout=0.1),
    Source("nav", 10, timeout=1.0),
    Source("page", 30),
)
ECHOES = "page"
"""The source whose sender echoes the beat; the others stamp some commands."""

NAMES = [source.name for source in SOURCES]
COMMANDS = CommandsConfig(sources=SOURCES)
CONFIGS = [
    Config(commands=COMMANDS),
    Config(commands=COMMANDS, mcu=McuConfig(trailing_comma=True)),
    Config(commands=COMMANDS, limits=LimitsConfig(linear_jerk=5.0, angular_jerk=20.0)),
    Config(commands=COMMANDS, limits=LimitsConfig(wheel_speed=12.0, linear_deceleration=2.5)),
    Config(commands=COMMANDS, control=ControlConfig(rate=20.0)),
    Config(commands=COMMANDS, control=ControlConfig(rate=250.0)),
]

STOP = Cause(5, "stop", "stopped", "stopped by ann", by="ann", kept=True)
FAULT = Cause(6, "fault", "wheel_reversed", "a wheel is dead", kept=True)
OFF = Cause(7, "inactive", "switched_off", "switched off by joe", by="joe", kept=True)

KEPT = [
    Latches(),
    Latches(),
    Latches(),
    Latches((STOP,), 5),
    Latches((STOP, FAULT, OFF), 7),
]
"""Latches that a robot starts with; usually none are set."""

Wheels = tuple[float, float, float, float]

speeds = st.sampled_from([0.0, 0.02, 0.3, -0.3, 0.7, -1.0, 1.0, 30.0, -1e300])
turns = st.sampled_from([0.0, 0.0, 0.5, -1.5, 4.0, -60.0, 1e300])
twists = st.builds(Twist, speeds, turns)
names = st.sampled_from(NAMES)
stamping = st.sampled_from([name for name in NAMES if name != ECHOES])
places = st.floats(-1e6, 1e6)


def read(line: bytes) -> Wheels:
    """Return the wheel speeds of a line from the host. Fail on any other form of line."""
    values = []
    for letter, start in zip("abcd", (0, 8, 16, 24), strict=True):
        token = line[start : start + 7].decode("ascii")
        assert token[0] == letter, line
        assert token[1] in "pn", line
        assert token[4] == ".", line
        assert (token[2:4] + token[5:]).isdigit(), line
        assert start == 24 or line[start + 7 : start + 8] == b",", line
        values.append(float(token[2:]) * (1 if token[1] == "p" else -1))
    return values[0], values[1], values[2], values[3]


def write(wheels: Wheels) -> bytes:
    """Return a reply of the microcontroller."""
    return (
        ",".join(
            f"{letter}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}"
            for letter, speed in zip("abcd", wheels, strict=True)
        )
        + "\r\n"
    ).encode()


def numbers(value: object) -> Iterator[float]:
    """Yield every float in a tree of builtins."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict):
        for item in value.values():
            yield from numbers(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from numbers(item)


class Books:
    """The test's own record of one source.

    It follows section 1 of SAFETY.md and shares no code with the robot.
    """

    def __init__(self, source: Source) -> None:
        self.priority = source.priority
        self.timeout_ns = round(source.timeout * NS_PER_S)
        self.stamped_ns: int | None = None
        """Last accepted stamped command; None while the clock is not proven."""
        self.since_zero_ns = 0
        """Zeros from then on arm."""
        self.start_over()

    def start_over(self) -> None:
        self.wish, self.heard_ns, self.since_ns = REST, -(10**15), 0
        self.neutral = False

    def is_live(self, now_ns: int) -> bool:
        return now_ns - self.heard_ns <= self.timeout_ns

    def take(self, wish: Twist, at_ns: int) -> None:
        if at_ns - self.heard_ns > 10 * NS_PER_S:
            self.neutral = False
        if wish == REST and at_ns >= self.since_zero_ns:
            self.neutral = True
        if not self.is_live(at_ns):
            self.since_ns = at_ns
        self.wish, self.heard_ns = wish, at_ns


def did(answer: Answer) -> bool:
    """Return whether the request was obeyed and changed something."""
    return answer.success and not answer.message.startswith("nothing")


class RobotMachine(RuleBasedStateMachine):
    """One robot with its guard, a port, a microcontroller and a few commanders."""

    @initialize(
        config=st.sampled_from(CONFIGS), rolling=st.booleans(), latches=st.sampled_from(KEPT)
    )
    def start(self, config: Config, rolling: bool, latches: Latches = KEPT[0]) -> None:
        self.latches = latches
        self.robot = Robot(config, latches)
        self.stepped = SteppedRobot(self.robot)
        self.config, self.limits = config, self.robot.config.limits
        self.guard = Guard(self.robot.link_setup.codec.stop, self.robot.config)
        self.quiet_ns = round(NS_PER_S * max(0.1, 4 / config.rate_hz))
        self.period_ms = 1000 / config.rate_hz
        self.books = {s.name: Books(s) for s in SOURCES}
        self.now_ns = 50 * NS_PER_S
        self.button: bool | None = None
        """The emergency stop as the board reports it now, None if it does not."""
        self.reported: bool | None = None
        """The last report of the emergency stop, None before the first one."""
        self.reported_ns = self.late_ns = 0
        """Time of the last report, and the longest time between two steps since then."""
        self.port_open, self.opened, self.blocked, self.shutting_down = True, 1, False, False
        self.trip: Trip = ""
        self.superseded = False
        self.commands: list[Command] = []
        self.requests: list[Request] = []
        self.received: list[Received] = []
        # the microcontroller: its received and sent lines
        self.told: Wheels = (0.0, 0.0, 0.0, 0.0)
        self.turning: Wheels = self.told
        self.heard_ns: int | None = None
        self.stalled_ns = 0
        """Sum of the stalls of the daemon since the last good line, ns."""
        self.good_in_row = 0
        # the wire
        self.sent: Wheels = self.told
        self.sent_ns = self.now_ns
        self.sent_twist = REST
        self.broken = True
        self.before: Outputs | None = None
        self.told_link, self.was_open, self.last_opened = "down", False, 0
        self.pose, self.sampled_ns = Pose(), self.now_ns - NS_PER_S
        self.fastest = 0.0
        self.left_out: tuple[str, ...] = ()
        self.sequence, self.beat_ns = 0, 0
        """The newest number and beat of the sender that echoes."""
        self.caught_up_ns = 0
        """Until then, a speed without a stamp may have waited while the daemon stalled."""
        self.clocks_become_known()
        self.step(tick=False)
        if rolling:
            for _ in range(4):
                self.step(reply=True)
            self.add_request("activate")
            self.step(reply=True)
            self.command("app", REST)
            self.command("nav", REST)
            self.step(reply=True)
            self.cruise("app", Twist(0.7, 0.5), 30, 1)

    def clocks_become_known(self) -> None:
        """Send zeros before the port opens. The clocks of the senders that stamp are then known."""
        for _ in range(50):
            self.now_ns += 50 * MS
            wall_ns = self.now_ns + WALL_NS
            stamping = [name for name in NAMES if name != ECHOES]
            for name in stamping:
                self.books[name].stamped_ns = self.now_ns
            zeros = [Command(name, REST, self.now_ns, wall_ns, name) for name in stamping]
            now = Instant(self.now_ns, wall_ns)
            self.stepped.step(Inputs(now, tick=False, port_open=False, commands=tuple(zeros)))

    # events

    @rule(count=st.integers(1, 12), reply=st.booleans())
    def time_passes(self, count: int, reply: bool) -> None:
        for _ in range(count):
            self.step(reply=reply)

    @rule(
        ms=st.sampled_from([0.5, 3.0, 14.0, 40.0, 90.0, 260.0, 700.0, 1100.0]), tick=st.booleans()
    )
    def a_step_comes_early_or_late(self, ms: float, tick: bool) -> None:
        self.step(ms=ms, tick=tick)

    @rule(ms=st.sampled_from([30.0, 120.0, 300.0, 1500.0, 12_000.0]), reply=st.booleans())
    def the_loop_stalls(self, ms: float, reply: bool) -> None:
        self.step(ms=ms, reply=reply)

    @rule(name=names, twist=twists, count=st.integers(1, 30), every=st.integers(1, 4))
    def cruise(self, name: str, twist: Twist, count: int, every: int) -> None:
        for i in range(count):
            if i % every == 0:
                self.command(name, twist)
            self.step(reply=True)

    @rule(name=names, twist=twists, late_us=st.integers(-900, 9000))
    def a_command_comes(self, name: str, twist: Twist, late_us: int) -> None:
        self.command(name, twist, arrived_ns=self.now_ns + late_us * 1000)

    @rule(name=names)
    def a_zero_comes(self, name: str) -> None:
        self.command(name, REST)

    @rule(name=stamping, twist=twists)
    def a_prompt_stamped_command_comes(self, name: str, twist: Twist) -> None:
        stamped_ns = self.books[name].stamped_ns
        # After 100 s the least delay has risen by 50 ms, and a prompt command looks early.
        if stamped_ns is not None and 0 < self.now_ns - stamped_ns < 90 * NS_PER_S:
            self.books[name].stamped_ns = self.now_ns
            self.command(name, twist, stamp_ns=self.now_ns + WALL_NS)

    @rule(name=stamping, twist=twists)
    def a_new_clock_is_proven(self, name: str, twist: Twist) -> None:
        """No command of a clock counts before the end of its first timeout."""
        book, first_ns = self.books[name], self.now_ns
        while book.stamped_ns is None and self.now_ns - first_ns < book.timeout_ns:
            stamp_ns = self.now_ns + WALL_NS
            command = Command(name, twist, self.now_ns, stamp_ns, name)
            self.refused(("unproven",), command, ms=self.period_ms, ticks=True)
        if book.stamped_ns is None:
            book.stamped_ns = self.now_ns
            self.command(name, twist, stamp_ns=self.now_ns + WALL_NS)

    @rule(name=stamping, twist=twists, late_ms=st.integers(20, 9000))
    def a_command_comes_late(self, name: str, twist: Twist, late_ms: int) -> None:
        book = self.books[name]
        if book.stamped_ns is not None and self.now_ns - book.stamped_ns < 9 * NS_PER_S:
            stamp_ns = self.now_ns + WALL_NS - book.timeout_ns - late_ms * MS
            command = Command(name, twist, self.now_ns, stamp_ns, name)
            # Refusals that last for 2 s have a code of their own.
            self.refused(("stale", "set_back", "stamps"), command)

    @rule(
        twist=twists,
        age_ms=st.sampled_from([None, -9000, -1, 301, 1000, 9000]),
        echoes=st.booleans(),
    )
    def a_command_with_a_wrong_echo_comes(
        self, twist: Twist, age_ms: int | None, echoes: bool
    ) -> None:
        """The beat is too old, from the future, of another run (None), or missing."""
        self.command(ECHOES, REST)
        self.step()
        age_ns = None if age_ms is None or not echoes else age_ms * MS
        beat = Echo(1, self.now_ns - (age_ns or 0)) if echoes else None
        self.sequence += 1
        command = Command(
            ECHOES, twist, self.now_ns, sequence=self.sequence, echo=beat, age_ns=age_ns
        )
        late = ("too_old", "round_trip") if age_ns and age_ns > 0 else ("from_future",)
        self.refused(("no_echo",) if beat is None else late if age_ns else ("other_run",), command)

    @rule(twist=twists)
    def a_command_with_an_echo_comes_twice(self, twist: Twist) -> None:
        self.command(ECHOES, twist)
        repeated = msgspec.structs.replace(self.commands[-1], arrived_ns=self.now_ns + 20 * MS)
        self.refused(("not_newer",), repeated)

    @rule(name=names, bad=st.sampled_from([math.nan, math.inf, -math.inf]), linear=st.booleans())
    def a_command_that_is_no_number_comes(self, name: str, bad: float, linear: bool) -> None:
        twist = Twist(bad, 0.0) if linear else Twist(0.0, bad)
        self.refused(("not_finite",), Command(name, twist, self.now_ns))

    @rule(name=st.sampled_from(["", "stranger", "App", "cmd/app", "teleop "]), twist=twists)
    def a_stranger_commands(self, name: str, twist: Twist) -> None:
        self.refused(("unknown_source",), Command(name, twist, self.now_ns))

    @rule(count=st.integers(1, 5), age_us=st.integers(0, 5000))
    def good_lines_come(self, count: int, age_us: int) -> None:
        self.receive(write(self.turning) * count, count, age_us)

    @rule(
        data=st.sampled_from(
            [b"\r\n", b"ap1", b"\x00\xff~", b"garbage\n", b"x" * 300, b"ap01.00,bp01.00\r\n"]
        )
        | st.binary(max_size=40)
    )
    def garbage_comes(self, data: bytes) -> None:
        self.receive(data.replace(b",", b";") + b"!\n", 0)
        self.good_in_row = 0 if self.told_link != "up" else self.good_in_row

    @rule(place=st.integers(0, 30), flipped=st.sampled_from([0x80, 0xA0]))
    def a_damaged_line_comes(self, place: int, flipped: int) -> None:
        line = bytearray(write(self.turning))
        line[place] ^= flipped  # the result is never a valid line
        self.receive(bytes(line), 0)
        self.good_in_row = 0 if self.told_link != "up" else self.good_in_row

    @rule(wheel=st.integers(0, 3), speed=st.sampled_from([-99.99, 81.0, 99.99, 60.0, -60.0]))
    def an_impossible_line_comes(self, wheel: int, speed: float) -> None:
        wheels = [*self.turning]
        wheels[wheel] = speed
        self.receive(write((wheels[0], wheels[1], wheels[2], wheels[3])), 1)
        self.step()

    @rule(count=st.integers(2, 120))
    def impossible_lines_come_for_a_while(self, count: int) -> None:
        for _ in range(count):
            self.receive(write((95.0, -95.0, 95.0, -95.0)), 1)
            self.step()
        self.receive(write((5.0, 5.0, 5.0, 5.0)), 1)
        self.step()

    @rule(gain=st.sampled_from([0.0, -1.0, 2.5, 9.0]), wheel=st.integers(0, 3))
    def an_encoder_lies_for_a_second(self, gain: float, wheel: int) -> None:
        for i in range(int(1000 / self.period_ms)):
            if i % 4 == 0:
                self.command("app", Twist(0.7, 0.0))
            wheels = [*self.turning]
            wheels[wheel] = max(-99.0, min(99.0, wheels[wheel] * gain))
            self.receive(write((wheels[0], wheels[1], wheels[2], wheels[3])), 1)
            self.step()

    @rule()
    def the_port_closes(self) -> None:
        self.port_open = False
        self.step()

    @rule()
    def the_port_opens(self) -> None:
        self.opened += not self.port_open
        self.port_open = True

    @rule()
    def the_port_is_lost_and_found_between_two_steps(self) -> None:
        self.opened += 1
        self.port_open = True
        self.step(reply=True)

    @rule(blocked=st.booleans())
    def the_output_blocks(self, blocked: bool) -> None:
        self.blocked = blocked

    @rule(
        verb=st.sampled_from(["stop", "clear", "clear", "activate", "deactivate"]),
        now=st.booleans(),
        off=st.sampled_from([0, 0, 0, -1, 1, None]),
    )
    def somebody_asks(self, verb: Verb, now: bool, off: int | None) -> None:
        """Request a service.

        A `clear` or `activate` names the latch, a number next to it, or none.
        """
        self.add_request(verb, off)
        if now:
            self.step(reply=True)

    @rule()
    def everything_is_released(self) -> None:
        """Clear both latches, activate the robot and open the port.

        Without this rule, most runs would end with a latched robot.
        """
        self.opened += not self.port_open
        self.port_open, self.blocked = True, False
        if self.reported is not None:
            self.button = False
            self.step(reply=True)
        for _ in range(2):
            self.add_request("clear")
            self.step(reply=True)
        self.add_request("activate")
        for _ in range(4):
            self.step(reply=True)
        for name in NAMES:
            self.command(name, REST)
        self.step(reply=True)

    @rule(button=st.sampled_from([None, False, True]), count=st.integers(0, 60))
    def the_emergency_stop_changes(self, button: bool | None, count: int) -> None:
        """Change the emergency-stop input that the board reports in each step.

        None means no report.
        """
        self.button = button
        for i in range(count):
            if i % 4 == 0:
                self.command("app", Twist(0.7, 0.5))
            self.step(reply=True)

    @rule(x=places, y=places, yaw=st.floats(-1e3, 1e3))
    def the_pose_is_set(self, x: float, y: float, yaw: float) -> None:
        self.requests.append(Request("set_pose", 2, Pose(x, y, yaw)))
        self.step(reply=True)

    @rule(
        name=st.sampled_from(
            ["linear_speed", "angular_speed", "linear_acceleration", "angular_acceleration",
             "linear_deceleration", "angular_deceleration", "linear_stop_deceleration",
             "angular_stop_deceleration", "wheel_speed"]
        ),
        share=st.sampled_from([0.0, 0.3, 0.8, 1.0, 1.2, 3.0]),
    )  # fmt: skip
    def a_limit_is_set(self, name: str, share: float) -> None:
        value = share * getattr(self.config.limits, name)
        self.requests.append(Request("set", 3, settings={f"limits.{name}": value}))
        self.step(reply=True)

    @rule()
    def the_odometry_is_reset(self) -> None:
        self.add_request("reset_odometry")
        self.step(reply=True)

    @precondition(lambda self: self.now_ns % 7 == 0)
    @rule()
    def it_leaves(self) -> None:
        self.shutting_down = True
        self.step(reply=True)

    # inputs of the robot

    def add_request(self, verb: Verb, off: int | None = 0) -> None:
        numbers = None
        if self.latches.causes and verb in ("clear", "activate") and off is not None:
            numbers = tuple([cause.number + off for cause in self.latches.causes])
        self.requests.append(Request(verb, 1, numbers=numbers))

    def command(
        self, name: str, twist: Twist, arrived_ns: int | None = None, stamp_ns: int | None = None
    ) -> None:
        at_ns = self.now_ns if arrived_ns is None else arrived_ns
        if self.commands:  # one queue: commands are taken in order of arrival
            at_ns = max(at_ns, self.commands[-1].arrived_ns)
        command = Command(name, twist, at_ns, stamp_ns, name)
        if name == ECHOES:
            self.sequence += 1
            self.beat_ns = max(self.beat_ns, at_ns - 20 * MS)
            command = Command(
                name, twist, at_ns, sequence=self.sequence,
                echo=Echo(1, self.beat_ns), age_ns=at_ns - self.beat_ns,
            )  # fmt: skip
        self.commands.append(command)

    def refused(
        self, codes: tuple[str, ...], command: Command, ms: float = 0.2, ticks: bool = False
    ) -> None:
        """Run a step with only this command, which must be refused with one of these codes."""
        self.step(ms=0.2, tick=False)
        before = dict(self.robot.counters)
        self.step(ms=ms, tick=ticks, reply=ticks, unheard=(command,))
        after = self.robot.counters
        keys = [
            "commands_of_new_senders" if code == "unproven" else f"command_{code}" for code in codes
        ]
        assert sum(after[key] - before.get(key, 0) for key in keys) == 1
        assert after["commands"] == before.get("commands", 0)
        if command.twist == REST and codes != ("not_newer",) and command.source in self.books:
            self.books[command.source].wish = REST  # a refused zero ends a speed, but arms nothing

    def receive(self, data: bytes, good: int, age_us: int = 0) -> None:
        """Receive bytes that contain this many good lines, or none."""
        if not self.port_open:
            return
        at_ns = max(self.now_ns - age_us * 1000, self.heard_ns or 0)
        self.received.append(Received(Instant(at_ns, at_ns + WALL_NS), data))
        self.read_lines(good, at_ns)

    def read_lines(self, good: int, at_ns: int) -> None:
        """Note good lines; a gap of a second between two of them starts a new session."""
        if good and self.opened == self.last_opened:
            if self.heard_ns is not None and at_ns - self.heard_ns >= NS_PER_S:
                self.reset_seen = True
            silent = self.heard_ns is not None and at_ns - self.heard_ns > self.quiet_ns
            if silent and self.told_link != "up":  # a stall of the loop is not a silence
                self.good_in_row = 0
        if good:
            self.good_in_row += good
            self.heard_ns, self.stalled_ns = at_ns, 0

    reset_seen = False

    def step(
        self,
        *,
        ms: float | None = None,
        tick: bool = True,
        reply: bool = False,
        unheard: tuple[Command, ...] = (),
    ) -> None:
        """Let time pass and run one step with all inputs, as the control loop does."""
        passed_ms = self.period_ms if ms is None else ms
        self.now_ns += int(passed_ms * MS)
        self.late_ns = max(self.late_ns, int(passed_ms * MS))
        if passed_ms > 150:
            self.caught_up_ns = self.now_ns + 100 * MS
        if 2 * passed_ms * MS >= self.quiet_ns:
            self.stalled_ns += int(passed_ms * MS)
        if self.opened != self.last_opened or not self.port_open:
            self.received.clear()
            self.heard_ns, self.good_in_row = None, 0
        share = passed_ms / (50 + passed_ms)  # a motor with a lag of 50 ms
        a, b, c, d = (
            round(turning + (target - turning) * share, 2)
            for turning, target in zip(self.turning, self.told, strict=True)
        )
        self.turning = a, b, c, d
        if passed_ms > 300:
            self.turning = self.told = (0.0, 0.0, 0.0, 0.0)  # the MCU's watchdog
        if reply and self.port_open:
            self.receive(write(self.turning), 1)
        pressed = self.reported
        if self.button is not None and self.port_open:
            word = b"pressed" if self.button else b"ok"
            self.receive(b"!status estop=%b\r\n" % word, 0)
            self.reported, self.reported_ns, self.late_ns = self.button, self.now_ns, 0
        # A press cuts the speed at once.
        self.broken = self.broken or (self.reported and not pressed) is True
        now = Instant(self.now_ns, self.now_ns + WALL_NS)
        commands, requests = tuple(self.commands), tuple(self.requests)
        outputs = self.stepped.step(
            Inputs(
                now=now,
                tick=tick,
                port_open=self.port_open,
                opened=self.opened,
                received=tuple(self.received),
                commands=commands + unheard,
                requests=requests,
                guard_trip=self.trip,
                superseded=self.superseded,
                shutting_down=self.shutting_down,
            )
        )
        self.commands.clear()
        self.requests.clear()
        self.received.clear()
        for request, answer in zip(requests, outputs.answers, strict=True):
            if request.verb == "set" and answer.success:
                self.note_limits(request.settings)
        self.keep_books(outputs, commands, requests)
        self.broken = self.broken or outputs.link != "up"
        self.check(outputs, requests)
        self.check_emergency_stop(outputs, requests)
        self.send(outputs)
        self.before = outputs

    def note_limits(self, settings: dict[str, Plain]) -> None:
        """Check new limits, which apply from this step on.

        A lower deceleration or another wheel speed may apply only when the robot is at rest.
        """
        before, at_rest = self.limits, self.broken or self.sent_twist == REST
        for key, value in settings.items():
            assert isinstance(value, float)
            name = key.removeprefix("limits.")
            if name == "wheel_speed" and value != before.wheel_speed:
                assert at_rest
            if name.endswith("deceleration") and value < getattr(before, name):
                assert at_rest
            self.limits = msgspec.structs.replace(self.limits, **{name: value})
        self.guard.use(self.robot.config)

    def keep_books(
        self, outputs: Outputs, commands: tuple[Command, ...], requests: tuple[Request, ...]
    ) -> None:
        """Record which sources must send a zero again, and which command is fresh."""
        lost = self.was_open and not self.port_open
        over = lost or self.opened != self.last_opened or self.reset_seen
        over = over or any(event.name == "fault" for event in outputs.events)
        for request, answer in zip(requests, outputs.answers, strict=True):
            if did(answer) and request.verb in ("clear", "activate"):
                over = True
                for book in self.books.values():
                    book.since_zero_ns = self.now_ns
                    if request.verb == "activate":
                        book.stamped_ns = None
        self.reset_seen = False
        self.was_open, self.last_opened, self.told_link = (
            self.port_open,
            self.opened,
            outputs.link,
        )
        if over:
            for book in self.books.values():
                book.start_over()
        for command in commands:
            waited = command.arrived_ns < self.caught_up_ns and command.twist != REST
            if command.stamp_ns is not None or command.echo is not None or not waited:
                self.books[command.source].take(command.twist, command.arrived_ns)

    # invariants

    def check(self, outputs: Outputs, requests: tuple[Request, ...]) -> None:
        assert outputs.reason
        self.check_mode(outputs, requests)
        self.check_latches(outputs, requests)
        self.check_odometry(outputs)
        snapshot = self.robot.snapshot(self.now_ns)
        values = msgspec.to_builtins((outputs.estimates, snapshot, outputs.applied, outputs.speeds))
        assert all(map(math.isfinite, numbers(values)))
        assert all(
            waiting(source.waits_for) or source.age_s is not None for source in snapshot.sources
        )

    def check_mode(self, outputs: Outputs, requests: tuple[Request, ...]) -> None:
        done = {r.verb for r, a in zip(requests, outputs.answers, strict=True) if did(a)}
        mode, was = outputs.mode, "" if self.before is None else self.before.mode
        if "stop" in done and "clear" not in done:
            assert mode in ("stopped", "fault", "shutdown")
        if was == "shutdown" or self.shutting_down:
            assert mode == "shutdown"
        elif was in ("stopped", "fault") and "clear" not in done:
            assert mode in (was, "fault")
        if any(event.name == "fault" for event in outputs.events) and "clear" not in done:
            assert mode in ("fault", "shutdown")
        if mode == "ready" and outputs.due:
            assert outputs.code in ("neutral", "no_command", *get_args(AgeCode))
        if mode == "driving":
            assert outputs.code in ("commanded", "zeros", "limits_zero")
            assert outputs.linked

    def check_latches(self, outputs: Outputs, requests: tuple[Request, ...]) -> None:
        """Check that a cause ends only by a call that names it, or that names none."""
        before, after = self.latches, outputs.latches
        self.latches = after
        done = [r for r, a in zip(requests, outputs.answers, strict=True) if did(a)]
        left = {(cause.kind, cause.code, cause.part, cause.by) for cause in after.causes}
        for cause in before.causes:
            if (cause.kind, cause.code, cause.part, cause.by) in left or cause.kind == "inactive":
                continue
            calls = [request for request in done if request.verb == "clear"]
            assert any(r.numbers is None or cause.number in r.numbers for r in calls)
        if before.of("inactive") and not after.of("inactive"):
            assert "activate" in {request.verb for request in done}
        fresh = {cause.number for cause in after.causes} - {c.number for c in before.causes}
        assert all(number > before.last for number in fresh)
        if any(request.verb == "stop" for request in done):
            assert after.of("stop")
        assert (before is after) == (before == after)
        assert not after.causes or outputs.mode not in ("waiting", "ready", "driving")

    def check_emergency_stop(self, outputs: Outputs, requests: tuple[Request, ...]) -> None:
        """Check that an emergency stop that is pressed, or silent for long, stops the robot.

        No clear succeeds meanwhile.
        """
        since_ns = self.now_ns - self.reported_ns
        # A late computer is excused once for 0.1 s.
        silent = self.reported is not None and since_ns > 600 * MS + 2 * self.late_ns
        if self.reported and since_ns <= 500 * MS:
            assert self.robot.snapshot(self.now_ns).estop == "pressed"
        elif silent:
            assert self.robot.snapshot(self.now_ns).estop in ("pressed", "silent")
        if self.reported or silent:
            assert outputs.mode in ("stopped", "fault", "shutdown")
            assert outputs.speeds.as_tuple() == (0.0, 0.0, 0.0, 0.0)
            assert outputs.latches.of("stop")
            for request, answer in zip(requests, outputs.answers, strict=True):
                assert request.verb != "clear" or not answer.success
        elif self.reported is False and since_ns <= 500 * MS:
            assert self.robot.snapshot(self.now_ns).estop == "released"

    def check_odometry(self, outputs: Outputs) -> None:
        """Check that the pose moves no further than the wheels allow since the last line.

        The faster wheel speed of both ends of this time counts. Odometry does not fill long
        silences. A line has the time of its sample slot, which may be some periods before its
        arrival and is never later. A wheel that is left out gives back what it missed meanwhile.
        """
        out = self.robot.snapshot(self.now_ns).doubt.left_out
        newly, self.left_out = not set(out) <= set(self.left_out), out
        drive, feedback = self.config.drive, self.config.feedback
        for estimate in outputs.estimates:
            fastest = max(map(abs, estimate.speeds.as_tuple())) * drive.wheel_radius
            assert fastest <= feedback.wheel_speed * drive.wheel_radius
            dt = (estimate.at.mono_ns - self.sampled_ns) / NS_PER_S
            assert dt >= 0.0
            # Missing lines are filled in, but not more than a second of them.
            dt = min(dt, MAX_FILLED_GAP_S) + 2 * self.period_ms / 1000 + LEFT_OUT_S * newly
            fastest, self.fastest = max(fastest, self.fastest), fastest
            most = fastest * dt
            x, y = estimate.pose.x - self.pose.x, estimate.pose.y - self.pose.y
            slack = 1e-9 * (1 + abs(self.pose.x) + abs(self.pose.y))
            assert math.hypot(x, y) <= most + slack
            turned = math.remainder(estimate.pose.yaw - self.pose.yaw, math.tau)
            assert abs(turned) <= most * 2 / drive.wheel_separation + 1e-9
            self.pose, self.sampled_ns = estimate.pose, estimate.at.mono_ns
        self.pose = self.robot.snapshot(self.now_ns).pose

    def send(self, outputs: Outputs) -> None:
        """Send the line as `ControlLoop._send` does, and check the bytes on the wire."""
        line, self.trip = checked(self.guard, outputs)
        assert self.trip == ""
        if line is None:
            self.superseded = False
            return
        assert outputs.due
        # A question moves nothing: the board keeps the speeds of the last line.
        wheels = self.sent if line == b"?\r\n" else self.check_line(line, outputs)
        self.superseded = self.blocked or not self.port_open
        if self.superseded:
            return
        self.guard.record_written(line)
        self.sent, self.sent_ns, self.sent_twist = wheels, self.now_ns, outputs.applied
        self.broken = False
        self.told = wheels

    def check_line(self, line: bytes, outputs: Outputs) -> Wheels:
        comma = self.config.mcu.trailing_comma
        assert len(line) == (34 if comma else 33)
        assert line[31:] == (b",\r\n" if comma else b"\r\n")
        wheels = read(line)
        assert all(abs(wheel) <= self.limits.wheel_speed + ROUNDING for wheel in wheels)
        self.check_says(wheels, outputs)
        if any(wheels):
            assert outputs.linked
            assert self.port_open
            assert self.good_in_row >= 3
            assert self.heard_ns is not None
            # After a stall, the board gets a third of the silence time to answer.
            extra_ns = self.stalled_ns + self.quiet_ns // 3 if self.stalled_ns else 0
            assert self.now_ns - self.heard_ns <= self.quiet_ns + extra_ns
        grows = any(
            abs(new) > abs(old) or new * old < 0 for new, old in zip(wheels, self.sent, strict=True)
        )
        if grows or outputs.mode == "driving":
            self.check_commanded(outputs)
        self.check_limits(outputs)
        return wheels

    def check_says(self, wheels: Wheels, outputs: Outputs) -> None:
        """Check that the line contains the speeds that the outputs report as applied."""
        drive, twist = self.config.drive, outputs.applied
        half = twist.angular * drive.wheel_separation / 2
        right = (twist.linear + half) / drive.wheel_radius
        left = (twist.linear - half) / drive.wheel_radius
        for speed, target in zip(wheels, (right, left, left, right), strict=True):
            assert abs(speed - target) <= ROUNDING

    def check_commanded(self, outputs: Outputs) -> None:
        """Check that the robot follows only a fresh command of a source that has sent a zero."""
        assert outputs.mode == "driving"
        book = self.books[outputs.source]
        assert book.neutral
        assert book.is_live(self.now_ns)
        assert outputs.command_ns == book.heard_ns
        for other in self.books.values():
            armed = other.neutral or other.priority > book.priority
            if other.is_live(self.now_ns) and armed:
                assert (-book.priority, book.since_ns) <= (-other.priority, other.since_ns)
        for now, last, wish, most in (
            (
                outputs.applied.linear,
                self.sent_twist.linear,
                book.wish.linear,
                self.limits.linear_speed,
            ),
            (
                outputs.applied.angular,
                self.sent_twist.angular,
                book.wish.angular,
                self.limits.angular_speed,
            ),
        ):
            assert min(0.0, last, max(wish, -most)) - 1e-9 <= now
            assert now <= max(0.0, last, min(wish, most)) + 1e-9

    def check_limits(self, outputs: Outputs) -> None:
        """Check that each axis changes within its limits since the last line that was sent."""
        limits, applied, last = self.limits, outputs.applied, self.sent_twist
        dt = (self.now_ns - self.sent_ns) / NS_PER_S
        silent = self.reported is not None and self.now_ns - self.reported_ns > 500 * MS
        if self.broken or silent or (applied == REST and dt > 0.25):
            last = REST  # it was cut meanwhile, so no ramp applied
        braking = outputs.mode in ("stopped", "fault", "shutdown")
        longest = max(0.05, 1.5 / self.config.rate_hz)
        full = limits.wheel_speed - 0.01
        drive = self.config.drive
        for twist in (applied, last):
            across = abs(twist.angular) * drive.wheel_separation / 2
            if (abs(twist.linear) + across) / drive.wheel_radius >= full:
                return
        for now, was, up, down, stop in (
            (
                applied.linear,
                last.linear,
                limits.linear_acceleration,
                limits.linear_deceleration,
                limits.linear_stop_deceleration,
            ),
            (
                applied.angular,
                last.angular,
                limits.angular_acceleration,
                limits.angular_deceleration,
                limits.angular_stop_deceleration,
            ),
        ):
            if abs(now) > abs(was) or now * was < 0:
                assert abs(now - was) <= max(up, down) * min(dt, longest) + 1e-9
                assert abs(now) <= up * min(dt, longest) + (abs(was) if now * was > 0 else 0) + 1e-9
            else:
                assert abs(now - was) <= (stop if braking else down) * dt + 1e-9


def explore(examples: int, steps: int) -> None:
    run_state_machine_as_test(
        RobotMachine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


@pytest.mark.parametrize("examples", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_no_sequence_of_events_breaks_an_invariant_of_the_robot(examples: int) -> None:
    explore(examples, 30)


def test_a_link_that_comes_up_between_two_ticks_reports_what_the_robot_waits_for() -> None:
    machine = RobotMachine()
    machine.start(config=CONFIGS[0], rolling=False)
    machine.good_lines_come(count=1, age_us=0)
    machine.a_step_comes_early_or_late(ms=10.0, tick=True)
    machine.good_lines_come(count=3, age_us=0)
    machine.a_step_comes_early_or_late(ms=0.5, tick=False)


def test_the_distance_of_a_second_of_impossible_feedback_is_not_made_up_later() -> None:
    machine = RobotMachine()
    machine.start(config=CONFIGS[0], rolling=True)
    machine.impossible_lines_come_for_a_while(count=100)


def test_settings_for_a_robot_at_rest_are_refused_until_the_zero_lines_were_sent() -> None:
    machine = RobotMachine()
    machine.start(config=CONFIGS[0], rolling=True)
    machine.cruise("app", Twist(0.5, 0.0), 60, 1)
    machine.the_output_blocks(blocked=True)
    machine.add_request("stop")
    for _ in range(19):
        machine.step(reply=True)
    assert machine.before is not None
    assert machine.before.applied == REST
    machine.blocked = False
    softer = {"limits.linear_deceleration": 0.3, "limits.linear_stop_deceleration": 0.5}
    machine.requests.append(Request("set", 3, settings={**softer}))
    machine.step(reply=True)
    (answer,) = machine.before.answers
    assert not answer.success


def test_a_lower_acceleration_limit_applies_immediately_despite_the_jerk_limit() -> None:
    machine = RobotMachine()
    machine.start(config=CONFIGS[3], rolling=True)
    machine.a_limit_is_set(name="linear_acceleration", share=0.3)


def test_a_stall_before_the_first_reply_of_a_new_port_is_integrated_only_once() -> None:
    machine = RobotMachine()
    machine.start(config=CONFIGS[0], rolling=True)
    machine.the_port_is_lost_and_found_between_two_steps()
    machine.the_loop_stalls(ms=120.0, reply=True)
    machine.time_passes(count=1, reply=True)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_no_long_sequence_of_events_breaks_an_invariant_of_the_robot() -> None:
    explore(2000, 60)
