"""`Robot.step(Inputs) -> Outputs`: the only mutable state, the only place that knows the order.

Fold the feedback into odometry, choose one command, gate by mode, limit, invert the kinematics,
report. Pure: time, bytes and commands come in, decisions go out. The shell around it carries
bytes, and `guard.py` checks what leaves.
"""

from __future__ import annotations

from collections import Counter

from acsard.drive.arbiter import REASONS, Arbiter, Choice
from acsard.drive.kinematics import Kinematics
from acsard.drive.limits import Limiter
from acsard.drive.modes import Mode, RefusedError, Trigger, next_mode
from acsard.drive.odometry import Odometry
from acsard.mcu.session import McuSession
from acsard.settings import Config
from acsard.values import (
    NS_PER_S,
    STILL,
    Answer,
    Event,
    Inputs,
    Outputs,
    Pose,
    Refusal,
    Request,
    Sample,
    Snapshot,
    Spread,
)

MAX_DT = 0.05
"""s; the longest step towards a command, or 1.5 periods if that is longer: after a stall the robot
must not leap."""

UNHEARD_S = 0.25
"""s without a line that left: by its contract the MCU stops by itself soon after, so start over
from rest instead of resuming a speed it no longer has."""

MAX_TEXT = 200
"""Characters of a refusal kept: it may quote what a stranger sent."""

BLIND_PERIOD_NS = NS_PER_S // 10
"""Zero lines go out at 10 Hz while nothing comes back: enough to wake the MCU, little to queue."""


class Robot:
    """One robot base: its link, pose, mode and commanders."""

    def __init__(self, config: Config) -> None:
        self.session = McuSession(config.mcu, config.rate_hz)
        self._kinematics = Kinematics(config.drive)
        self._odometry = Odometry(config.odometry, self._kinematics)
        self._arbiter = Arbiter(config.commands)
        self._limiter = Limiter(config.limits, self._kinematics)
        self._max_dt = max(MAX_DT, 1.5 / config.rate_hz)
        self._active = config.control.auto_activate
        self._mode = Mode.INACTIVE
        self._latch = ""
        self._choice = Choice("", None, "")
        self._speeds = STILL
        self._limited_ns = 0
        self._before = (self._limiter.state, 0)
        """The limiter and its time before the last line: restored when that line did not go."""
        self._line_ns = -BLIND_PERIOD_NS
        self._status = ("", "", "", "")
        self.counters: Counter[str] = Counter()
        """Totals since start: `commands`, and `command_<reason>` for each kind refused. The shell
        adds what it alone sees (superseded lines, missed periods)."""
        self._refused = ""
        self._stopped_ns = -1
        self._told_ns: dict[str, int] = {}
        self._port_trouble = ""
        self._arbiter.require_neutral()
        self._resume()

    def snapshot(self, now_ns: int, lateness_us: Spread) -> Snapshot:
        """What `state` and `diagnostics` show; costs too much for every step."""
        session = self.session
        counters = {"lines": session.good_lines}
        counters |= {f"line_{reason}": count for reason, count in session.rejects.items() if count}
        return Snapshot(
            pose=self._odometry.pose,
            measured=self._odometry.twist,
            speeds=self._odometry.speeds,
            sources=self._arbiter.sources(now_ns),
            counters=counters | self.counters,
            refused=self._refused,
            lateness_us=lateness_us,
        )

    def step(self, inputs: Inputs) -> Outputs:
        """Take all that happened since the last step; decide what happens now."""
        events: list[Event] = []
        samples = self._fold(inputs, events)
        answers = self._serve(inputs, events)
        self._hear(inputs)
        line = self._drive(inputs) if inputs.tick else None
        applied = self._limiter.twist
        status = (self._mode.value, self._reason(), self.session.link, self._choice.source)
        changed, self._status = status != self._status, status
        return Outputs(
            now=inputs.now,
            tick=inputs.tick,
            line=line,
            speeds=self._speeds,
            applied=applied,
            linked=self.session.link == "up",
            samples=samples,
            mode=status[0],
            reason=status[1],
            link=status[2],
            source=status[3],
            command_ns=self._choice.arrived_ns,
            status_changed=changed,
            events=tuple(events),
            answers=answers,
        )

    # fold

    def _fold(self, inputs: Inputs, events: list[Event]) -> tuple[Sample, ...]:
        session, before = self.session, self.session.link
        feedback = session.update(inputs.now, inputs.port_open, inputs.opened, inputs.received)
        link = session.link
        self._port_trouble = inputs.port_trouble
        if session.restarted:
            self._arbiter.require_neutral()
        if link != before:
            events.append(_link_event(link))
        if link != "up":
            # Nobody can be ramped at the other end, and what was wished then is old now.
            self._limiter.cut()
            self._speeds = STILL
            self._before = (self._limiter.state, inputs.now.mono_ns)
            self._fire(Trigger.LINK_LOST)
            if link == "down" and before != "down":
                self._arbiter.require_neutral()
        else:
            self._fire(Trigger.LINK_UP)
        return tuple([self._odometry.fold(line) for line in feedback])

    # requests

    def _serve(self, inputs: Inputs, events: list[Event]) -> tuple[Answer, ...]:
        if inputs.guard_trip:
            self._fault(f"the guard replaced a line: {inputs.guard_trip}", events)
        if inputs.leaving and self._mode is not Mode.LEAVING:
            self._fire(Trigger.LEAVE)
            events.append(Event("leaving", "ramping to zero, then STOP"))
        return tuple([self._answer(r, inputs.now.mono_ns, events) for r in inputs.requests])

    def _answer(self, request: Request, now_ns: int, events: list[Event]) -> Answer:
        before = self._mode
        try:
            message = self._obey(request, now_ns)
        except RefusedError as refusal:
            return Answer(request.id, False, str(refusal))
        last_ns = self._told_ns.get(request.verb)
        if self._mode is not before or last_ns is None or now_ns - last_ns > NS_PER_S:
            # What is repeated as fast as it can be sent is still a line of log a second.
            self._told_ns[request.verb] = now_ns
            events.append(Event(request.verb, message))
        return Answer(request.id, True, message)

    def _obey(self, request: Request, now_ns: int) -> str:
        match request.verb:
            case "stop":
                self._stopped_ns = now_ns
                self._mode = next_mode(self._mode, Trigger.STOP)
                if self._mode is Mode.LEAVING:
                    return "the daemon is going down: ramping to zero"
                if self._mode is Mode.FAULT:
                    return "in fault, which holds the robot already; srv/clear releases it"
                self._latch = "stopped by request"
                return "stopped and latched; srv/clear releases it"
            case "clear":
                asked_ns = now_ns if request.asked_ns is None else request.asked_ns
                if asked_ns <= self._stopped_ns or now_ns == self._stopped_ns:
                    raise RefusedError("a stop came at the same time or after; call it again")
                self._mode = next_mode(self._mode, Trigger.CLEAR)
                self._latch = ""
                self._arbiter.require_neutral()
                self._resume()
                return "cleared; each source must be neutral once before it drives"
            case "activate":
                self._mode = next_mode(self._mode, Trigger.ACTIVATE)
                if not self._active:
                    self._arbiter.require_neutral()
                self._active = True
                if self.session.link == "up":
                    self._fire(Trigger.LINK_UP)
                return "active"
            case "deactivate":
                self._mode = next_mode(self._mode, Trigger.DEACTIVATE)
                self._active = False
                return "inactive: ramping to zero; srv/activate switches it on"
            case "reset_odometry":
                self._odometry.set_pose(Pose())
                return "pose is x 0, y 0, yaw 0"
            case "set_pose":
                self._odometry.set_pose(request.pose or Pose())
                pose = self._odometry.pose
                return f"pose is x {pose.x:g}, y {pose.y:g}, yaw {pose.yaw:g}"

    def _resume(self) -> None:
        if self._active:
            self._mode = next_mode(self._mode, Trigger.ACTIVATE)
            if self.session.link == "up":
                self._fire(Trigger.LINK_UP)

    def _fault(self, why: str, events: list[Event]) -> None:
        self._limiter.cut()  # STOP went out in the line's place
        if self._mode in (Mode.FAULT, Mode.LEAVING):
            return
        self._fire(Trigger.FAULT)
        self._latch = why
        self._arbiter.require_neutral()
        events.append(Event("fault", f"{why}; srv/clear releases it", "error"))

    def _fire(self, trigger: Trigger) -> None:
        self._mode = next_mode(self._mode, trigger)

    # commands

    def _hear(self, inputs: Inputs) -> None:
        for refusal in inputs.refusals:
            self._refuse(refusal)
        for command in inputs.commands:
            reason = self._arbiter.accept(command)
            if reason:
                self._refuse(Refusal(reason, f"source {command.source}: {REASONS[reason]}"))
            else:
                self.counters["commands"] += 1

    def _refuse(self, refusal: Refusal) -> None:
        self.counters[f"command_{refusal.reason}"] += 1
        self._refused = refusal.text[:MAX_TEXT]

    # choose, gate, limit, invert

    def _drive(self, inputs: Inputs) -> bytes | None:
        now_ns = inputs.now.mono_ns
        self._choice = self._arbiter.choose(now_ns)
        twist = self._choice.twist
        self._fire(Trigger.NO_COMMAND if twist is None else Trigger.COMMAND)
        limiter = self._limiter
        if inputs.superseded:
            limiter.state, self._limited_ns = self._before
        self._before = (limiter.state, self._limited_ns)
        since = (now_ns - self._limited_ns) / NS_PER_S
        self._limited_ns = now_ns
        if self.session.link != "up" or since > UNHEARD_S:
            limiter.cut()
        elif self._mode is Mode.DRIVING and twist is not None:
            limiter.follow(twist, min(since, self._max_dt))
        else:
            limiter.coast(since, stop=self._mode in (Mode.STOPPED, Mode.FAULT, Mode.LEAVING))
        self._speeds = self._kinematics.wheel_speeds(limiter.twist)
        return self._line(now_ns)

    def _line(self, now_ns: int) -> bytes | None:
        codec = self.session.codec
        if not self.session.silent(now_ns):
            self._line_ns = now_ns
            return codec.stop if self._speeds == STILL else codec.encode(self._speeds)
        if now_ns - self._line_ns < BLIND_PERIOD_NS:
            return None
        self._line_ns = now_ns
        return codec.stop

    # report

    def _reason(self) -> str:
        match self._mode:
            case Mode.DRIVING:
                return f"driving: {self._choice.reason}"
            case Mode.READY:
                return self._choice.reason
            case Mode.WAITING:
                return self._waiting()
            case Mode.STOPPED | Mode.FAULT:
                return f"{self._latch}; call srv/clear"
            case Mode.INACTIVE:
                return "switched off; call srv/activate"
            case Mode.LEAVING:
                return "the daemon is going down"

    def _waiting(self) -> str:
        session = self.session
        if session.link == "down" and self._port_trouble:
            return self._port_trouble
        if session.link in ("booting", "stale") and session.sparse_s:
            return (
                f"the microcontroller's lines come {session.sparse_s:.2f} s apart; if it reports "
                f"by its own clock, set mcu.reply_period = {session.sparse_s:.2f}"
            )
        return _LINK_WORDS[session.link]


_LINK_WORDS = {
    "down": "the serial port is closed; it is being reopened",
    "booting": "the port is open; waiting for the microcontroller's first good lines",
    "up": "linked",
    "stale": "the microcontroller has fallen silent",
}


def _link_event(link: str) -> Event:
    return Event(
        f"link_{link}", _LINK_WORDS[link], "info" if link in ("up", "booting") else "warning"
    )
