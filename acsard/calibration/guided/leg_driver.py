"""One leg: decides the command from the daemon's messages and key presses, and records a run.

It sends zeros until the daemon accepts them, then the moves by their durations, then zeros until
the wheels stand. Any unexpected condition halts the leg for good; `halted` has the reason.

The run has the form that a log has. Each sender stamps its messages with its own clock, or not at
all. Within one key, the samples keep the spacing of their stamps, and the sample with the smallest
delay is taken to have arrived at once. No clock has to be set, and the fit finds the remaining
delays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

import numpy as np
from msgspec import Struct

from acsard.calibration.guided.legs import Leg
from acsard.calibration.log_table import Floats, Table
from acsard.calibration.runs import Run, runs
from acsard.client.commander import NEVER, OPENED_S, OPENING_S, objection
from acsard.client.follower import QUIET_S
from acsard.core.config.settings import DriveConfig
from acsard.core.messages.schema import Imu, JointState, Odometry, PoseStamped, RobotState, Time
from acsard.core.values import NS_PER_S, REST, Twist

STREAMS = {"wheels": ("left", "right"), "gyro": ("yaw_rate",), "places": ("x", "y")}

LONGEST_S = 5.0
"""Largest variation of the delay between stamps and arrivals, s.

A larger one is not due to a clock.
"""


class Sample(Struct, frozen=True):
    """A sample's arrival and its own stamp, s, and its values in the order of `STREAMS`."""

    came: float
    made: float | None
    values: tuple[float, ...]


class Recorder:
    """Recorder of the samples of one leg."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._right = joints[0], joints[3]
        self._left = joints[1], joints[2]
        self.samples: dict[str, list[Sample]] = {name: [] for name in STREAMS}

    def wheels(self, message: JointState, came: float) -> float:
        """Add wheel speeds and return the largest of them, rad/s."""
        speeds = dict(zip(message.name, message.velocity, strict=False))
        left, right = (
            (speeds[one] + speeds[other]) / 2 for one, other in (self._left, self._right)
        )
        self._take("wheels", message.header.stamp, came, (left, right))
        return max(map(abs, speeds.values()))

    def gyro(self, message: Imu, came: float) -> None:
        """Add a turn rate."""
        self._take("gyro", message.header.stamp, came, (message.angular_velocity.z,))

    def place(self, message: PoseStamped | Odometry, came: float) -> None:
        """Add a position. Its heading, if it has one, is ignored."""
        pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
        spot = pose.position
        self._take("places", message.header.stamp, came, (spot.x, spot.y))

    def _take(self, stream: str, stamp: Time, came: float, values: tuple[float, ...]) -> None:
        made = stamp.to_ns() / NS_PER_S if stamp.sec else None
        self.samples[stream].append(Sample(came, made, values))

    def run(self) -> Run:
        """Return the leg as a run. Raises `LogError` if there are too few wheel samples."""
        count = sum(map(len, self.samples.values()))
        columns: dict[str, Floats] = {"t": np.full(count, math.nan)}
        at = 0
        for stream, names in STREAMS.items():
            samples = self.samples[stream]
            rows = slice(at, at + len(samples))
            columns["t"][rows] = times(samples)
            for number, column in enumerate(names):
                columns[column] = np.full(count, math.nan)
                columns[column][rows] = [sample.values[number] for sample in samples]
            at += len(samples)
        order = np.argsort(columns["t"], kind="stable")
        columns = {column: values[order] for column, values in columns.items()}
        return runs(Table(columns, np.zeros(count, dtype=np.int64), ("",), ())).runs[0]


def times(samples: Sequence[Sample]) -> Floats:
    """Return the times of the samples by the local clock, s.

    Stamps give their spacing if every sample has one and the delay varies little.
    """
    came = np.array([sample.came for sample in samples])
    made = np.array([math.nan if s.made is None else s.made for s in samples])
    if not len(came) or np.isnan(made).any():
        return came
    late = came - made
    if float(np.ptp(late)) > LONGEST_S:
        return came
    return np.asarray(made + float(late.min()))


HELD_UP = "this computer was too busy for the calibration: end the other programs on it"

OBEYED_S = 1.5
"""Time allowed for the robot to follow a changed command, s. The ramp takes a part of it."""

DOUBT_S = 1.0
"""Time for which the robot may deviate from the command before the leg is halted, s."""

LINEAR_OFF, ANGULAR_OFF, OFF_SHARE = 0.05, 0.15, 0.3
"""Deviation that is allowed: m/s, rad/s, and a fraction of the command in addition."""

STILL = 0.02
"""Speed below which a wheel stands, rad/s."""

STANDING_S, STANDS_S = 0.5, 6.0
"""Time for which the wheels must stand, and time within which they must come to rest, s."""

ENTER = "\r\n"
PRESSED = "a key was pressed"


class Phase(StrEnum):
    OPENING = "opening"
    MOVING = "moving"
    SETTLING = "settling"
    DONE = "done"
    HALTED = "halted"


class LegDriver:
    """A leg while it is driven. All times are in s of the same clock."""

    def __init__(self, leg: Leg, source: str, drive: DriveConfig, now: float, sender: str) -> None:
        """Start a leg that is commanded as `source` by `sender`."""
        self._leg, self._source, self._drive, self._sender = leg, source, drive, sender
        self.phase = Phase.OPENING
        self.halted = ""
        """The reason why the leg was cut short, or ""."""
        self._begun = self._heard = self._stepped = self._changed = now
        self._number, self._ends = -1, now
        self._command = REST
        self._waits = "no state of the daemon has arrived"
        """Why the zeros do not count yet, or ""."""
        self._still_since: float | None = None
        self._doubted: float | None = None

    @property
    def over(self) -> bool:
        return self.phase in (Phase.DONE, Phase.HALTED)

    def progress(self, now: float) -> float:
        """Return the fraction of the leg that is done; 1 when it is over."""
        if self.over:
            return 1.0
        if self._number < 0:
            return 0.0
        behind = sum(move.seconds for move in self._leg.moves[: self._number + 1])
        return min(0.99, max(0.0, (behind - self._ends + now) / self._leg.seconds))

    def key(self, pressed: str, now: float) -> None:
        """Handle a key press.

        Enter is ignored at first, because the finger that started the leg may still rest on the
        key.
        """
        if self.phase is Phase.OPENING and pressed in ENTER:
            return
        if self.phase is Phase.MOVING and now - self._stepped > QUIET_S / 2:
            self._halt(HELD_UP)  # the person may have pressed it because the robot had stopped
        last = self._number == len(self._leg.moves) - 1
        if self.phase is Phase.MOVING and self._leg.by_key and last:
            self._settle(now)
        elif self.phase is not Phase.SETTLING or not self._leg.by_key:
            self._halt(PRESSED)

    def state(self, state: RobotState, now: float) -> None:
        """Handle a `state` message of the daemon."""
        self._heard = now
        why = self._objection(state)
        if state.mode in (*NEVER, "waiting"):
            self._halt(f"the robot is {state.mode}: {state.reason}")
        elif state.source not in ("", self._source):
            self._halt(f"{state.source} commands the robot now")
        elif self.phase is Phase.OPENING:
            self._waits = why
        elif state.sender not in ("", self._sender):
            self._halt(why)
        elif self.phase is Phase.MOVING:
            self._doubt(why or self._deviation(state, now), now)

    def wheels(self, fastest: float, now: float) -> None:
        """Handle wheel feedback: the fastest wheel turns at `fastest` rad/s."""
        self._heard = now
        if fastest > STILL:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = now

    def step(self, now: float) -> Twist:
        """Return the command for this time."""
        held_up, self._stepped = now - self._stepped, now
        # After a pause of this process, it is unknown whether the daemon was silent. The robot has
        # braked meanwhile, and the time of a move may be over, so that the next one would begin at
        # the wrong place.
        if held_up > QUIET_S / 2 and self.phase is Phase.MOVING:
            self._halt(HELD_UP)
        elif now - self._heard > QUIET_S:
            self._halt("nothing received from the daemon" if held_up <= QUIET_S / 2 else HELD_UP)
        if self.phase is Phase.OPENING:
            self._open(now)
        if self.phase is Phase.MOVING and now >= self._ends:
            self._next(now)
        if self.phase is Phase.SETTLING:
            self._stand(now)
        return self._command

    def _open(self, now: float) -> None:
        passed = now - self._begun
        if passed >= OPENING_S and not self._waits:
            self.phase, self._ends = Phase.MOVING, now
        elif passed >= OPENED_S:
            self._halt(self._waits)

    def _next(self, now: float) -> None:
        self._number += 1
        if self._number >= len(self._leg.moves):
            if self._leg.by_key:
                self._halt("no key was pressed although the robot must have turned a full circle")
            else:
                self._settle(now)
            return
        move = self._leg.moves[self._number]
        self._command = Twist(move.linear, move.angular)
        # Count from the planned end of the last move, so that a late step does not lengthen the
        # drive.
        self._ends, self._changed = self._ends + move.seconds, now

    def _settle(self, now: float) -> None:
        self.phase, self._command = Phase.SETTLING, REST
        self._ends, self._still_since = now, None

    def _stand(self, now: float) -> None:
        if self._still_since is not None and now - self._still_since >= STANDING_S:
            self.phase = Phase.DONE
        elif now - self._ends > STANDS_S:
            self._halt("the wheels do not come to rest although zero is commanded")

    def _doubt(self, why: str, now: float) -> None:
        """Halt the leg if a deviation lasts for `DOUBT_S`.

        A computer that is busy for a moment sends late, so that the robot slows down; this is
        tolerated.
        """
        if not why:
            self._doubted = None
        elif self._doubted is None:
            self._doubted = now
        elif now - self._doubted >= DOUBT_S:
            self._halt(why)

    def _objection(self, state: RobotState) -> str:
        """Return why the commands of this calibration do not count, or ""."""
        if why := objection(state, self._source, self._sender):
            return why
        # If the source has a long timeout, the robot follows a command for long after the last one.
        (age,) = [one.age for one in state.sources if one.name == self._source]
        if age is None or age >= OPENING_S:
            return f"no command of source {self._source} has arrived for {OPENING_S:g} s"
        return ""

    def _deviation(self, state: RobotState, now: float) -> str:
        """Return how the wheels deviate from the command, or "".

        The wheels decide this, not a gyro: a gyro shows the turn that remains after skidding, which
        is not disobedience.
        """
        if now - self._changed < OBEYED_S:
            return ""
        if not state.wheels:
            return "the microcontroller sends no feedback"
        right, left = (state.wheels[a] + state.wheels[b] for a, b in ((0, 3), (1, 2)))
        linear = self._drive.wheel_radius * (right + left) / 4
        track = self._drive.wheel_separation * self._drive.wheel_separation_multiplier
        angular = self._drive.wheel_radius * (right - left) / 2 / track
        for told, does, off, unit in (
            (self._command.linear, linear, LINEAR_OFF, "m/s"),
            (self._command.angular, angular, ANGULAR_OFF, "rad/s"),
        ):
            if abs(does - told) > off + OFF_SHARE * abs(told):
                return (
                    f"the wheels turn at {does:.2f} {unit} although {told:.2f} is commanded: is "
                    "there another commander, a limit or an obstacle?"
                )
        return ""

    def _halt(self, why: str) -> None:
        if not self.over:
            self.phase, self._command, self.halted = Phase.HALTED, REST, why
