"""Decides the commands of one leg from the daemon's messages and from key presses.

A leg is one drive of a guided calibration. `LegDriver` goes through the phases of `Phase`. An
unexpected condition ends the leg early. `LegDriver.halted` then contains the reason.
"""

from __future__ import annotations

from collections import deque
from enum import StrEnum

from acsard.calibration.guided.drive_plan import Leg
from acsard.calibration.runs import STANDSTILL_SPEED
from acsard.client.follower import MAX_STATE_AGE_S
from acsard.client.ride import NEVER_DRIVING_MODES, OPEN_TIMEOUT_S, objection
from acsard.core.codes import HOST_CODES
from acsard.core.config.settings import Config, DriveConfig, LimitsConfig
from acsard.core.messages.schema import RobotState
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import AT_REST
from acsard.core.values import REST, Twist, WheelSpeeds

STALL_REASON = (
    "this computer was suspended, or it was too busy for the calibration: end the other programs "
    "on it"
)

OPENING_S = 0.2  # of the zeros at the beginning of a leg

RESPONSE_TIMEOUT_S = 1.5  # until the robot follows a changed command, including the ramp

DEVIATION_TIMEOUT_S = 1.0  # until the leg is halted if the daemon does not follow or report

STARVED_S = 0.4  # without a command that the daemon received, until the leg is halted

PATH_OFF_M, PATH_OFF_RAD = 0.1, 0.15
# The rolled path may differ from the commanded one by these, plus `SAME_SHARE` of the same motion
# and `OTHER_SHARE` of the other one. With more, the robot could leave the free floor.
SAME_SHARE, OTHER_SHARE = 0.05, 0.03

MAX_SAMPLE_GAP_S = 2.0  # between two samples of the wheel speeds, to continue the path

# A leg is done when the wheels stand still for `STANDING_S`, and halted after `STANDS_S`.
STANDING_S, STANDS_S = 0.5, 6.0


class Phase(StrEnum):
    """The phases of a leg, in their order. `HALTED` can follow any phase except `DONE`."""

    OPENING = "opening"  # the tool commands zero until the daemon accepts the commands of this leg
    MOVING = "moving"  # the tool commands the moves of the leg
    SETTLING = "settling"  # the tool commands zero until the wheels stand still
    DONE = "done"
    HALTED = "halted"


class CommandedPath:
    """Compares the path that the wheels rolled in a leg with the commanded path.

    The commanded path has the ramps of `[limits]`, but no `speed_limit`. The robot follows late, so
    the rolled distance must be near one of the commanded distances of the last
    `RESPONSE_TIMEOUT_S`. The same holds for the turn of the wheels; a gyro shows less if the robot
    skids.
    """

    def __init__(self, drive: DriveConfig, limits: LimitsConfig, now: float) -> None:
        self._kinematics = Kinematics(drive)
        self._limits, self._motion = limits, AT_REST
        self._lever = drive.wheel_separation * drive.wheel_separation_multiplier / 2.0
        self._stepped = now
        self._sampled: tuple[float, Twist] | None = None  # stamp of the last sample, s, and twist
        self._lengths = [0.0, 0.0]  # commanded metres and radians, without their signs
        # Commanded and rolled distance, m (forward is +), and turn, rad (left is +).
        self._commanded, self._rolled = (0.0, 0.0), (0.0, 0.0)
        # With the time of each, s, in the last `RESPONSE_TIMEOUT_S`.
        self._recent: deque[tuple[float, tuple[float, float]]] = deque([(now, self._commanded)])

    def command(self, twist: Twist, now: float) -> None:
        """Add the path of the command `twist`, which was in force since the last call."""
        passed, self._stepped = now - self._stepped, now
        if passed > 0.0:
            self._motion = self._motion.follow(twist, passed, self._limits, self._kinematics)
        allowed = self._motion.twist
        x, turn = allowed.linear * passed, allowed.angular * passed
        self._commanded = self._commanded[0] + x, self._commanded[1] + turn
        self._lengths[0] += abs(x)
        self._lengths[1] += abs(turn)
        self._recent.append((now, self._commanded))
        while len(self._recent) > 1 and self._recent[1][0] < now - RESPONSE_TIMEOUT_S:
            self._recent.popleft()

    def wheels(self, speeds: WheelSpeeds, stamp: float) -> None:
        """Add the path that the wheels rolled since the last sample. `stamp` is its time, s."""
        twist, before = self._kinematics.twist(speeds), self._sampled
        self._sampled = stamp, twist
        if before is None or not 0.0 < stamp - before[0] <= MAX_SAMPLE_GAP_S:
            return
        half, (x, turn) = (stamp - before[0]) / 2.0, self._rolled
        self._rolled = (
            x + (before[1].linear + twist.linear) * half,
            turn + (before[1].angular + twist.angular) * half,
        )

    @property
    def error(self) -> str:
        """The difference that is too large, as a text; "" if there is none."""
        distance, turn = self._lengths
        limits = (
            PATH_OFF_M + SAME_SHARE * distance + OTHER_SHARE * turn * self._lever,
            PATH_OFF_RAD + SAME_SHARE * turn + OTHER_SHARE * distance / self._lever,
        )
        for i, (limit, unit, name) in enumerate(
            zip(limits, ("m", "rad"), ("rolled", "turned"), strict=True)
        ):
            recent, rolled = [path[i] for _, path in self._recent], self._rolled[i]
            if not min(recent) - limit <= rolled <= max(recent) + limit:
                return (
                    f"the robot {name} {rolled:.2f} {unit} by its wheels although "
                    f"{self._commanded[i]:.2f} {unit} was commanded: is there a speed limit or an "
                    "obstacle, does another program send commands, or does the board not reach the "
                    "commanded speeds (`acsard mcu check`)?"
                )
        return ""


class LegDriver:
    """Decides the commands of one leg.

    Every `now` is a time, s, on a monotonic clock that also advances while the computer is
    suspended.
    """

    def __init__(self, leg: Leg, source: str, config: Config, now: float, sender: str) -> None:
        self._leg, self._source, self._sender = leg, source, sender
        self._path = CommandedPath(config.drive, config.limits, now)
        self.phase = Phase.OPENING
        self.halted = ""  # the reason why the leg ended early
        self.disturbed = False  # the reason is temporary, so the leg can be repeated
        self.silent = False  # no messages arrived; if they do again, the leg can be repeated
        self._begun = self._received = self._stepped = now
        self._number, self._ends = -1, now
        self._command = REST
        self._waits = "no message with the daemon's state has arrived"  # "" if it accepts commands
        self._starved = f"the daemon has received no command of source {source} for {STARVED_S:g} s"
        self._still_since: float | None = None
        self._deviates_since: float | None = None

    @property
    def over(self) -> bool:
        return self.phase in (Phase.DONE, Phase.HALTED)

    def progress(self, now: float) -> float:
        """Return the fraction of the leg that is done, from 0 to 1; 1 when the leg is over."""
        if self.over:
            return 1.0
        if self._number < 0:
            return 0.0
        planned_s = sum(move.seconds for move in self._leg.moves[: self._number + 1])
        return min(0.99, max(0.0, (planned_s - self._ends + now) / self._leg.seconds))

    def key(self, pressed: str, now: float) -> None:
        """Process a key press, which halts the leg.

        In the last move of a leg with `by_key` it ends this move instead. Enter is ignored in the
        phase OPENING, because the person may still hold the key that started the leg.
        """
        if self.phase is Phase.OPENING and pressed in "\r\n":
            return
        if self.phase is Phase.MOVING and now - self._stepped > MAX_STATE_AGE_S / 2:
            # The person may have pressed a key only because the robot stopped in a pause of this
            # process.
            self._halt(STALL_REASON)
        last = self._number == len(self._leg.moves) - 1
        if self.phase is Phase.MOVING and self._leg.by_key and last:
            self._settle(now)
        elif self.phase is not Phase.SETTLING or not self._leg.by_key:
            self._halt("a key was pressed")

    def state(self, state: RobotState, now: float) -> None:
        """Process the daemon's `state`. Halt the leg if the robot does not follow its commands."""
        self._received = now
        why = self._objection(state)
        if state.mode in (*NEVER_DRIVING_MODES, "waiting"):
            late = state.code in HOST_CODES
            self._halt(f"the robot is {state.mode}: {state.why}", disturbed=late)
        elif state.source not in ("", self._source):
            self._halt(
                f"the source {state.source} commands the robot now: end the program that uses "
                "this source, and start again"
            )
        elif self.phase is Phase.OPENING:
            self._waits = why
        elif state.sender not in ("", self._sender):
            self._halt(why)
        elif self.phase is Phase.MOVING:
            disturbed = why == self._starved
            if not (why or state.wheels):
                why = "the microcontroller sends no feedback: check its cable and its power supply"
                disturbed = True
            self._tolerate_briefly(why, now, disturbed=disturbed)

    def wheels(self, speeds: WheelSpeeds, stamp: float, now: float) -> None:
        """Process wheel speeds from the daemon, rad/s, of the time `stamp`, s."""
        self._received = now
        self._path.wheels(speeds, stamp)
        if max(map(abs, speeds.as_tuple())) > STANDSTILL_SPEED:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = now

    def step(self, now: float) -> Twist:
        held_up, self._stepped = now - self._stepped, now
        self._path.command(self._command, now)
        # If this process was paused, the robot has braked, and the next move would begin at the
        # wrong place. The pause also hides whether the daemon was silent, and the person who
        # started the leg may have left.
        if held_up > MAX_STATE_AGE_S / 2 and self.phase in (Phase.OPENING, Phase.MOVING):
            self._halt(STALL_REASON, disturbed=True)
        elif now - self._received > MAX_STATE_AGE_S:
            late = held_up > MAX_STATE_AGE_S / 2
            self.silent = self.silent or not (late or self.over)
            silence = "no messages of the daemon arrive: does the daemon run (`acsard doctor`)?"
            self._halt(STALL_REASON if late else silence, disturbed=late)
        elif self.phase in (Phase.MOVING, Phase.SETTLING) and (error := self._path.error):
            self._halt(error, disturbed=True)
        if self.phase is Phase.OPENING:
            self._open(now)
        if self.phase is Phase.MOVING and now >= self._ends:
            self._next(now)
        if self.phase is Phase.SETTLING:
            self._await_standstill(now)
        return self._command

    def _open(self, now: float) -> None:
        passed = now - self._begun
        if passed >= OPENING_S and not self._waits:
            self.phase, self._ends = Phase.MOVING, now
        elif passed >= OPEN_TIMEOUT_S:
            self._halt(self._waits)

    def _next(self, now: float) -> None:
        self._number += 1
        if self._number >= len(self._leg.moves):
            if self._leg.by_key:
                self._halt(
                    "no key was pressed although the robot must have turned a full circle: start "
                    "again, and press SPACE at the end of the circle"
                )
            else:
                self._settle(now)
            return
        move = self._leg.moves[self._number]
        self._command = Twist(move.linear, move.angular)
        # Not to `now`: a late step then does not lengthen the drive.
        self._ends += move.seconds

    def _settle(self, now: float) -> None:
        self.phase, self._command = Phase.SETTLING, REST
        self._ends, self._still_since = now, None

    def _await_standstill(self, now: float) -> None:
        if self._still_since is not None and now - self._still_since >= STANDING_S:
            self.phase = Phase.DONE
        elif now - self._ends > STANDS_S:
            self._halt(
                "the wheels do not come to rest although zero is commanded: does somebody push the "
                "robot, or does an encoder report a speed at rest?"
            )

    def _tolerate_briefly(self, why: str, now: float, *, disturbed: bool) -> None:
        # If this computer is busy for a moment, the robot only slows down.
        if not why:
            self._deviates_since = None
        elif self._deviates_since is None:
            self._deviates_since = now
        elif now - self._deviates_since >= DEVIATION_TIMEOUT_S:
            self._halt(why, disturbed=disturbed)

    def _objection(self, state: RobotState) -> str:
        if why := objection(state, self._source, self._sender):
            return why
        # A source with a long timeout still drives the robot after its commands stop arriving.
        (age,) = [source.age for source in state.sources if source.name == self._source]
        if age is None or age >= STARVED_S:
            return self._starved
        return ""

    def _halt(self, why: str, *, disturbed: bool = False) -> None:
        if not self.over:
            self.phase, self._command, self.halted = Phase.HALTED, REST, why
            self.disturbed = disturbed
