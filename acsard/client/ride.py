"""The rules for a program that drives the robot: zeros first, the newest wish, zeros until rest.

The program calls `Ride.wish` for as long as a speed is wanted, `Ride.state` with each state of the
robot, and sends the command that `Ride.due` returns. If the robot does not follow, the ride ends:
`Ride.ended` has the reason, and wishes are ignored until the person lets go. This module is pure,
and all programs that drive the robot use it and its time limits.
"""

from __future__ import annotations

import math

from acsard.client.follower import SETTLED_S, Follower
from acsard.core.messages.schema import RobotState, SourceState
from acsard.core.values import REST, Seconds, Twist

SEND_PERIOD_S = 0.05  # five commands within a source's default timeout of 0.25 s

OPENING_PERIOD_S = 0.01  # of the zeros at the beginning

OPEN_TIMEOUT_S = 4.0  # for these zeros to be accepted: another sender may finish its drive

# A ride ends after this time without an effect, or without a command of the program. It is longer
# than a short delay.
GRACE_S = 0.5

RELEASE_TIMEOUT_S = 1.5  # without a wish, a control such as a key counts as released

STALE_S = 0.1  # age of a wish that the person may no longer have

MAX_SOURCE_TIMEOUT_S = 10.0  # of any source: the robot follows no older command

STANDSTILL = 0.01, 0.02  # m/s and rad/s

# Without a speed below `SLOWER` times the lowest one for `SLOWS_S`, something else moves the robot.
SLOWER, SLOWS_S = 0.97, 1.0

# That no command moves and that do not end by themselves.
NEVER_DRIVING_MODES = ("inactive", "stopped", "fault", "shutdown")

PAUSE = (
    "this program sent no command for {:.1f} s, so the robot was stopped and the drive was not "
    "finished: was the computer suspended, did something keep the program from running, or did the "
    "network to the daemon fail?"
)


class _Stopping:
    # Finds out whether the robot has stopped following the last speed of a sender.

    def __init__(self, source: str, sender: str, moved: Seconds = -math.inf) -> None:
        self._source, self._sender = source, sender
        self._moved = self._slower_at = moved
        self._slowest = math.inf  # in units of `STANDSTILL`

    def is_over(self, now: Seconds) -> bool:
        return now - self._moved >= MAX_SOURCE_TIMEOUT_S

    def state(self, state: RobotState, now: Seconds) -> None:
        if now - self._moved >= SETTLED_S and self._shows_the_end(state, now):
            self._moved = -math.inf

    def _shows_the_end(self, state: RobotState, now: Seconds) -> bool:
        if state.mode in NEVER_DRIVING_MODES:
            return True
        # While the network holds the commands, the robot may rest because the last speed has not
        # arrived yet. So the daemon must have accepted a zero.
        ours = _entry(state, self._source)
        if ours is None or ours.age is None or now - ours.age - self._moved < SETTLED_S:
            return False
        if state.source != self._source or state.sender not in ("", self._sender):
            return True
        speed = math.inf  # unknown without feedback
        if state.linear is not None and state.angular is not None:
            speed = max(abs(state.linear) / STANDSTILL[0], abs(state.angular) / STANDSTILL[1])
        if speed < SLOWER * self._slowest:
            self._slowest, self._slower_at = speed, now
        return speed < 1.0 or now - self._slower_at >= SLOWS_S


class Ride:
    """Decides the commands of one sender. Times are on a clock that a suspend does not stop, s.

    The sender has a command source and a public name. The follower says whether the daemon is
    silent.
    """

    def __init__(self, source: str, sender: str, follower: Follower, now: Seconds) -> None:
        self.ended = ""  # why wishes are ignored; "" if they are not
        self.objection: str | None = None  # "" if the robot follows, None before the first state
        self.followed = now  # when it last did, or when nothing was wanted
        self.begun: Seconds | None = None  # when the first speed was due
        self._source, self._sender, self._follower = source, sender, follower
        self.grace_s = GRACE_S  # without an effect, until the ride ends
        self._wish: Twist | None = None  # not zero
        self._wished = -math.inf  # when a wish or a delayed one last came
        self._is_held = False  # a speed was wished, and nobody has let go
        self._opened: Seconds | None = None  # first zero of the opening
        self._is_open = False  # a state has shown that the robot follows
        self._asked = now  # last call of `due`
        self._last, self._sent = REST, -math.inf  # last command, and its time
        self._zero_is_due = False
        self._stopping = _Stopping(source, sender)

    def moved(self, at: Seconds) -> None:
        """Record that the sender last sent a speed at this time."""
        self._stopping = _Stopping(self._source, self._sender, at)

    def wish(self, twist: Twist | None, now: Seconds) -> None:
        """Want a speed until the next call, for at most `STALE_S`.

        A zero lets go: it is sent, and a ride that has ended may begin again. None lets go of a
        speed without that, as between two repeats of a held key.
        """
        if twist is None:
            self._wish = None
            return
        if self._wish is None and now - self._wished > RELEASE_TIMEOUT_S:
            self._begin("")
        self._wished = now
        self._is_held = twist != REST
        if not self._is_held:
            self.ended, self._wish, self._zero_is_due = "", None, True
        elif not self.ended:
            self._wish = twist

    def hold(self, now: Seconds) -> None:
        """Record a wish that came too late: it has no effect, but the person may still hold it."""
        self._wish, self._wished, self._is_held = None, now, True

    def state(self, state: RobotState, now: Seconds) -> None:
        """Process a state, which the follower has processed already."""
        self.objection = objection(state, self._source, self._sender)
        self._stopping.state(state, now)
        if not self.objection:
            self.followed = now
            self._is_open = self._is_open or self._opened is not None
        elif self._is_held and (self._opened is None or now - self._opened >= SETTLED_S):
            # Otherwise the robot would drive as soon as the mode allows it, which the person may
            # not expect. An earlier state may be older than the first command.
            disarmed = self._opened is None or self._is_open
            if refuses_for_good(state, self._source) or (
                disarmed and _wait(state, self._source) == "neutral"
            ):
                self._begin(self.objection)

    def due(self, now: Seconds) -> Twist | None:
        """Return the command to send now, or None. Call it at least every `period`."""
        paused, self._asked = now - self._asked, now
        if now - self._wished > STALE_S:
            self._wish = None
        if self._wish is None:
            self.followed = now
            if not self._is_open:
                self._opened = None
        elif self._opened is not None and paused > GRACE_S:
            self._begin(PAUSE.format(paused))
        elif silence := self._follower.silence(now):
            self._begin(silence)
        elif self._is_open and self.objection and now - self.followed >= self.grace_s:
            self._begin(self.objection)
        elif not self._is_open:
            self._opened = now if self._opened is None else self._opened
            if now - self._opened >= OPEN_TIMEOUT_S:
                self._begin(self.objection or "")
        if self._wish is None:
            command = REST if self._zero_is_due or not self.is_over(now) else None
        else:
            command = self._wish if self._is_open else REST
        # One millisecond less, because the caller may wait for exactly one period.
        if command is None or (command == self._last and now - self._sent < self.period - 0.001):
            return None
        self._last, self._sent = command, now
        if command == REST:
            self._zero_is_due = False
        else:
            self.begun = now if self.begun is None else self.begun
            self.moved(now)
        return command

    @property
    def period(self) -> Seconds:
        """Longest time until the next call of `due`."""
        opening = self._wish is not None and self._last == REST
        return OPENING_PERIOD_S if opening else SEND_PERIOD_S

    def is_over(self, now: Seconds) -> bool:
        """Return whether the robot follows no speed of this sender any more.

        Then no zero is sent, because it would keep other senders from driving. A few zeros are not
        enough: after a stall of the network, all commands arrive within 1 ms, and the daemon
        accepts the oldest, maybe a speed, and drops the others as too fast.
        """
        return self._wish is None and self._stopping.is_over(now)

    def _begin(self, ended: str) -> None:
        self.ended, self._wish = ended, None
        self._opened, self._is_open = None, False


def objection(state: RobotState, source: str, sender: str) -> str:
    """Return why the robot does not follow a sender (by public name); "" if it does."""
    if state.mode in NEVER_DRIVING_MODES:
        return state.why
    ours = _entry(state, source)
    if ours is None:
        names = ", ".join(entry.name for entry in state.sources)
        return (
            f"{source} is not one of commands.sources: {names}; add {source} to commands.sources "
            "in the robot's acsard.toml and restart the daemon"
        )
    if state.mode == "waiting":
        return state.why
    if ours.wait == "command":
        return (
            f"the daemon receives no command of source {source}; `acsard top` shows whether the "
            "daemon refuses commands"
        )
    if state.source != source:
        return ours.waits_for or state.why
    # The robot is `ready`: the zeros of this client arrive, but do not let it drive yet.
    if state.mode != "driving":
        return state.why
    if state.sender in ("", sender):
        return ""
    return (
        f"another program, {state.sender}, drives the robot as source {source}: end that program, "
        "or wait until it sends no commands"
    )


def can_drive(state: RobotState) -> bool:
    """Return whether some command can move the robot in its present mode."""
    return state.mode not in NEVER_DRIVING_MODES and state.mode != "waiting"


def lacks_only_commands(state: RobotState, source: str) -> bool:
    """Return whether the robot would drive if the commands of this source reached the daemon."""
    return can_drive(state) and _wait(state, source) == "command"


def receives_commands(state: RobotState, source: str) -> bool:
    """Return whether the daemon receives commands of this source, even late ones."""
    return _wait(state, source) not in (None, "command")


def refuses_for_good(state: RobotState, source: str) -> bool:
    """Return whether waiting cannot help: no command moves the robot, or there is no source."""
    return state.mode in NEVER_DRIVING_MODES or _entry(state, source) is None


def _wait(state: RobotState, source: str) -> str | None:
    ours = _entry(state, source)
    return None if ours is None else ours.wait


def _entry(state: RobotState, source: str) -> SourceState | None:
    return next((entry for entry in state.sources if entry.name == source), None)
