"""All that a robot knows between two steps, as plain data.

A recording stores it as it is, beside the memory of the guard (`guard.py`). With the inputs of the
later steps, both give all later outputs. No field contains configuration: `Robot` has that beside
it, and each method gets it as an argument.
"""

from __future__ import annotations

from msgspec import Struct, field

from acsard.core.board_inputs import BoardInputs, inputs_after
from acsard.core.config.settings import Config
from acsard.core.link.link_diagnosis import UnansweredLines
from acsard.core.link.link_output import Output
from acsard.core.link.session import McuSession
from acsard.core.motion.arbiter import Arbiter, Choice
from acsard.core.motion.arbiter_text import CommandEvents
from acsard.core.motion.consistency import ConsistencyChecks
from acsard.core.motion.event_throttle import EventThrottle
from acsard.core.motion.lifecycle import Lifecycle
from acsard.core.motion.modes import Mode
from acsard.core.motion.odometry import Odometry
from acsard.core.motion.sanity import Sanity
from acsard.core.motion.uncertainty import ErrorModel
from acsard.core.values import (
    AT_REST,
    STILL,
    Event,
    Latches,
    Motion,
    Ns,
    SpeedCap,
    Status,
    Trip,
    Twist,
    WheelSpeeds,
)


class Draft(Struct):
    """The line that `drive` made last, which may not have left, and why the next one is due."""

    motion: Motion = AT_REST
    speeds: WheelSpeeds = STILL  # zero after a press and without a link
    made_ns: Ns = 0
    # The twist to follow and the mode of the last line. None after a press: a new line is due.
    made_of: tuple[Twist | None, Mode] | None = None
    waits: bool = False  # for `sent`
    trip: Trip = ""  # why the guard replaced the line, until the robot has latched the fault
    pressed_ns: Ns = 0  # last press of the emergency stop or a bumper


class State(Struct):
    life: Lifecycle
    command_events: CommandEvents
    draft: Draft
    inputs: BoardInputs
    odometry: Odometry
    checks: ConsistencyChecks
    out: Output = field(default_factory=Output)
    session: McuSession = field(default_factory=McuSession)
    sanity: Sanity = field(default_factory=Sanity)
    unanswered: UnansweredLines = field(default_factory=UnansweredLines)
    linked_once: bool = False  # the link was up since the start
    arbiter: Arbiter = field(default_factory=Arbiter)
    choice: Choice = Choice()
    cap: SpeedCap = SpeedCap(None)
    status: Status = Status("", "booting", "", "down")
    # Since the start: `commands` (accepted), `command_<reason>` (refused),
    # `commands_of_new_senders` (not proved yet), lines to the board, and events.
    counters: dict[str, int] = {}
    refused: tuple[str, Ns] | None = None  # the last command, and when
    # Verb, client and arrival of the last request: a call of `srv/stop` arrives as two, and the
    # second, which leads to the reply, is not logged.
    request: tuple[str, str, Ns | None] = ("", "", None)
    announced: tuple[Event, ...] = ()  # for the next `hear`
    throttle: EventThrottle = field(default_factory=EventThrottle)

    def count(self, name: str, more: int = 1) -> None:
        self.counters[name] = self.counters.get(name, 0) + more

    def cut(self) -> None:
        """Set the speed to zero without a ramp: the motors have stopped."""
        self.draft.speeds, self.out.motion = STILL, AT_REST


def initial(latches: Latches, config: Config, model: ErrorModel) -> State:
    """Return the state after a start of the daemon; `latches` decides the first mode."""
    life = Lifecycle(latches)
    state = State(
        life,
        CommandEvents(life.mode),
        Draft(made_of=(None, life.mode)),
        inputs_after(latches, config),
        Odometry.initial(model),
        ConsistencyChecks.initial(model),
    )
    if latches.causes:
        kind, why = f"start -> {life.mode}", life.why
        state.announced = (Event("mode", why.text, "warning", kind=kind, code=why.code),)
    state.arbiter.require_neutral()
    return state
