"""The robot as one pure object, with three methods that know an order: `hear`, `drive` and `sent`.

`hear` takes what arrived, updates the odometry and the mode, and selects the command to follow.
`drive` limits this command and returns the line for the board. `sent` says which line really left:
only then the limiter advances, so a line that was lost leaves no trace. The control loop reads and
writes the port, and `core/guard.py` checks each line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import assert_never, cast

from msgspec.structs import replace

from acsard.core.codes import Reason, RefusalCode, reason, sentence
from acsard.core.config.live import Changes, changed, describe_changes
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import Config, LimitsConfig
from acsard.core.link.feedback import Line
from acsard.core.link.link_output import QUESTION_LINE
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.motion.arbiter_text import missed, refused, waiting
from acsard.core.motion.battery import empty_reason
from acsard.core.motion.emergency_stop import DRIVER_FAULT_REASON, PRESSED_REASON
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import coast, follow
from acsard.core.motion.modes import Mode, RefusedError
from acsard.core.motion.uncertainty import ErrorModel
from acsard.core.motion.wheels import LEAST_SPEED
from acsard.core.reasons import reason_of
from acsard.core.robot_memory import State, initial
from acsard.core.values import (
    AT_REST,
    NS_PER_S,
    REST,
    STILL,
    Answer,
    Command,
    Estimate,
    Event,
    Heard,
    Instant,
    Latches,
    Motion,
    News,
    Ns,
    Plain,
    Pose,
    Refusal,
    Request,
    SpeedCap,
    Status,
    Trip,
    Twist,
    WheelSpeeds,
)

# Largest time step of the limiter, s, but at least 1.5 control periods. After a longer stall the
# speed does not jump.
MAX_DT = 0.05

# After this time without a line, the next acceleration starts from rest, because the board may have
# stopped the motors. The margin is for a board whose clock is slightly fast.
WRITE_PAUSE_S = WATCHDOG_S - 0.05

HALTED = (Mode.STOPPED, Mode.FAULT, Mode.SHUTDOWN)  # modes with the stop deceleration

UNLATCHED = (Mode.DRIVING, Mode.READY)  # their reason depends only on the choice and the settings

QUIET = News()

PORT_LENT = (
    "the serial port is closed; type `acsard call activate` to open it again (before it `acsard "
    "call clear`, if the robot is stopped or in fault). The robot may have been pushed until then, "
    "so its pose is less certain: `acsard call set_pose` says where it is"
)

ALREADY_LENT = (
    "the serial port is lent to another program already: wait until that ends, or type "
    "`acsard call activate` if it ended without giving the port back"
)

NOTHING_CHANGED = "nothing changed: all settings already have these values"

UNDECLARED = "with fewer than 400 encoder counts per turn of a wheel, set mcu.encoder_counts"

MAX_REFUSAL_LENGTH = 200  # characters in `state`: the text may quote the message of a client


def error_model(config: Config) -> ErrorModel:
    return ErrorModel(
        config.odometry,
        Kinematics(config.drive),
        config.mcu.encoder_counts,
        config.limits,
        config.feedback,
        config.mcu.wheels.names,
    )


class Robot:
    def __init__(
        self,
        config: Config,
        latches: Latches = Latches(),  # noqa: B008
        state: State | None = None,
    ) -> None:
        # As after a start of the daemon with `latches`, or as a recording says in `state`.
        self.config = config  # in force; a `set` replaces it
        self.link_setup = LinkSetup.of(config.mcu, config.rate_hz, config.feedback)
        self.model = error_model(config)
        self.state = state or initial(latches, config, self.model)
        # Motion, twist, limits and cap with which the motion does not change; its wheel speeds.
        self._steady: tuple[tuple[Motion, Twist, LimitsConfig, float] | None, WheelSpeeds]
        self._steady = (None, STILL)  # as the two below, a cache: the next step makes it again
        # Until then, a step decides nothing if it brings only lines; 0: not even now.
        self._calm_until_ns: Ns = 0
        self._nothing = Heard(True)  # what `hear` gets if nothing arrives

    def waits(self, now_ns: Ns) -> dict[str, Reason]:
        """Return what each source that sends, but does not drive, waits for."""
        sources = self.state.arbiter.status(now_ns, self.config.commands)
        return {
            source.name: waiting(source.waits_for)
            for source in sources
            if source.waits_for.what not in ("nothing", "command")
        }

    @property
    def status(self) -> Status:
        """The mode, and why the robot moves or does not move."""
        return self.state.status

    @property
    def latches(self) -> Latches:
        """The latches in force, even after an exception in a step."""
        return self.state.life.latches

    @property
    def port_released(self) -> bool:
        """Whether another program may use the serial port."""
        return self.state.life.port_released

    @property
    def applied(self) -> Twist:
        """The twist in the line of `drive`, after all limits; after `sent`, in the last one."""
        draft = self.state.draft
        return (draft if draft.waits else self.state.out).motion.twist

    @property
    def speeds(self) -> WheelSpeeds:
        """The wheel speeds in the last line of `drive`; zero after a press and without a link."""
        return self.state.draft.speeds

    @property
    def command_ns(self) -> Ns | None:
        """Arrival of the command that the robot follows."""
        return self.state.arbiter.arrived_ns(self.state.choice)

    @property
    def travelled(self) -> float:
        """Distance driven since the daemon started, m, forwards plus backwards, by odometry."""
        return self.state.odometry.travelled

    def hear(self, now: Instant, heard: Heard) -> News:
        """Process what arrived since the last call, and return what is to be published."""
        state, now_ns = self.state, now.mono_ns
        life, arbiter, steps = state.life, state.arbiter, state.session.steps
        before_ns = steps.begin(self.link_setup, now_ns)
        calm = steps.is_steady and now_ns < self._calm_until_ns
        if calm and heard == self._nothing:
            return QUIET
        events = [*heard.events, *state.announced]
        state.announced = ()
        if before_ns is not None and steps.is_late:
            arbiter.resume(before_ns, now_ns, self.config.commands)
        if life.unshown:
            life.begin(now_ns)
        if heard.missed:
            state.count("missed_periods", heard.missed)
            events.append(missed(heard.missed, self.config.period_ns))
        estimates = self._fold(now, heard, events)
        if calm and heard.asks_nothing and not events:
            # `_fold` makes an event for each fault, and a link that is lost ends the calm.
            self._calm_until_ns = self._calm_until()
            if now_ns < self._calm_until_ns:
                return News(estimates) if estimates else QUIET
        answers: tuple[Answer, ...] = ()
        if heard.requests or state.draft.trip or heard.shutting_down:
            answers = self._serve(now, heard, events)
        if heard.speed_cap is not None:
            self._cap_speed(heard.speed_cap, events)
        for announcement in heard.announced:
            arbiter.announce(announcement)
        if heard.commands or heard.refusals:
            self._accept_commands(now_ns, heard, events)
        is_chosen = now_ns >= arbiter.until_ns
        if is_chosen:
            self._choose(now_ns)
        mode, status, changed = life.mode, state.status, False
        urgent = (state.choice.twist, mode) != state.draft.made_of
        if is_chosen or events or answers or mode._value_ != status.mode or mode not in UNLATCHED:
            self._restate(heard.port_trouble)
            changed = state.status is not status
        if changed or urgent:
            why = Reason(state.status.code, state.status.reason)
            events += state.command_events.changes(mode, state.choice, why)
        logged = state.throttle.lines(events, now_ns)
        self._calm_until_ns = self._calm_until() if steps.is_steady and not urgent else 0
        if not (estimates or answers or logged or urgent or changed):
            return QUIET
        return News(estimates, answers, logged, urgent, changed)

    def _calm_until(self) -> Ns:
        # Until then nothing changes by itself: neither the choice nor the link, no latch holds, no
        # event waits for its line, and no input of the board may fall silent.
        state = self.state
        if (
            state.life.mode not in UNLATCHED
            or state.life.unshown
            or state.throttle.held
            or state.inputs.expects_reports(state.session)
        ):
            return 0
        return min(state.arbiter.until_ns, state.session.until_ns)

    def drive(self, now: Instant) -> bytes | None:
        """Return the line for the board: in each control period, and at once if `News` is urgent.

        None: no line is due, because the board does not answer. Call `hear` before, and `sent`
        after each line.
        """
        state = self.state
        now_ns, twist, limits = now.mono_ns, state.choice.twist, self.config.limits
        draft, out, mode = state.draft, state.out, state.life.mode
        draft.made_of, draft.made_ns = (state.choice.twist, mode), now_ns
        since = (now_ns - out.made_ns) / NS_PER_S
        pressed = out.made_ns < draft.pressed_ns
        if pressed or state.session.link != "up" or since > WRITE_PAUSE_S:
            # The first written line after a press contains zeros, even if the input is already
            # released and the commands that arrived meanwhile may move the robot.
            motion, speeds = AT_REST, STILL
        elif mode is Mode.DRIVING and twist is not None:
            cap = math.inf if state.cap.speed is None else state.cap.speed
            wanted = (out.motion, twist, limits, cap)
            steady, speeds = self._steady
            if wanted == steady:
                motion = out.motion
            else:
                dt = min(since, max(MAX_DT, 1.5 / self.config.rate_hz))
                motion = follow(out.motion, twist, dt, limits, self.model.kinematics, cap)
                speeds = self.model.kinematics.wheel_speeds(motion.twist)
                if motion is out.motion:
                    self._steady = (wanted, speeds)
        else:
            motion = coast(out.motion, since, limits, stop=mode in HALTED)
            speeds = self.model.kinematics.wheel_speeds(motion.twist)
        draft.motion, draft.speeds = motion, speeds
        line = state.session.line(self.link_setup, out, now_ns, speeds)
        draft.waits = line is not None
        return line

    def sent(self, at_ns: Ns, line: bytes | None, trip: Trip = "") -> None:
        """Record what left of the line of `drive`, and when: nothing, if `line` is None.

        `trip` says why the guard replaced it with the stop line.
        """
        state, draft, session = self.state, self.state.draft, self.state.session
        draft.waits, draft.trip = False, trip
        if trip or line is None:
            self._calm_until_ns = 0
        if line is None:
            closed = session.link == "down"
            state.out.dropped(draft.made_ns, closed=closed, trip=bool(trip))
            if not closed:
                state.count("lines_superseded")
            return
        state.count("lines_sent")
        commanded = state.out.speeds
        motion, speeds = (AT_REST, STILL) if trip else (draft.motion, draft.speeds)
        state.out.wrote(
            self.link_setup,
            line,
            at_ns,
            draft.made_ns,
            motion,
            speeds,
            silent=session.silent(draft.made_ns),
            trip=bool(trip),
        )
        state.checks.wheels.add_command(commanded, state.out.pause_ns / NS_PER_S)
        if line == QUESTION_LINE:
            session.asks(at_ns)

    # Feedback.

    def _fold(self, now: Instant, heard: Heard, events: list[Event]) -> tuple[Estimate, ...]:
        state = self.state
        session, before = state.session, state.status.link
        feedback = session.update(
            self.link_setup, state.out, now, heard.port_open, heard.opened, heard.received
        )
        link, inputs = session.link, state.inputs
        sent = state.counters.get("lines_sent", 0)
        if (feedback and sent >= state.unanswered.due_lines) or link != "up":
            warning = state.unanswered.check(
                sent,
                session.good_lines,
                link == "up",
                self.config.mcu.reply_period,
            )
            if warning is not None:
                events.append(warning)
        if link != "up":
            if before == "up" and not state.life.port_released:
                state.count("link_lost")
                if session.steps.late_s:
                    state.count("link_lost_host_stall")
            state.sanity.forget()
        if session.restarted:
            # No sender drives before the link is up for the first time, so accept a zero that was
            # sent during the start.
            state.arbiter.require_neutral(now.mono_ns if state.linked_once else 0)
        if session.events:
            events += session.events
        if session.reopened:
            inputs.reopen()
            self._nothing = Heard(True, heard.opened)
        is_watched, safety = inputs.expects_reports(session), self.config.safety
        if is_watched:
            self._watch_inputs(now, events)
        if link != "up":
            # Without a link the daemon cannot ramp, so set the speeds to zero at once. When the
            # link returns, a command from before the loss is too old to follow.
            state.cut()
            state.life.link(up=False)
            if link == "down" and before != "down":
                state.arbiter.require_neutral(now.mono_ns)
        elif before != "up" or is_watched or safety.bumpers or safety.estop == "required":
            # Nothing else changes whether an input is missing.
            state.linked_once = True
            state.life.link(up=not inputs.missing(safety))
        if heard.gyro and self.model.claims is not None:
            state.checks.gyro.add_samples(heard.gyro)
        if not feedback:
            return ()
        estimates: list[Estimate] = []
        for line in feedback:
            if self._is_plausible(line, now, events):
                estimates.append(self._check_and_integrate(line, now, events))
        return tuple(estimates)

    def _watch_inputs(self, now: Instant, events: list[Event]) -> None:
        state = self.state
        # A press stops the robot even if it began and ended between two wake-ups.
        inputs, life, config, now_ns = state.inputs, state.life, self.config, now.mono_ns
        estop, bumpers = inputs.estop, inputs.bumpers
        if life.port_released:
            inputs.lend()
        changes = inputs.process_reports(state.session, now_ns, config)
        if changes or state.session.status.new:
            state.arbiter.until_ns = 0  # bumpers limit the choice
        events += changes
        if estop.pressed_now is not None:
            state.count("emergency_stops")
            life.press(estop.pressed_now, now)
        if bumpers.pressed_now is not None:
            state.count("bumper_presses")
            if bumpers.latching(config.safety):
                life.press(bumpers.pressed_now, now)
            else:
                state.arbiter.require_neutral(now_ns)
        if estop.pressed_now is not None or bumpers.pressed_now is not None:
            # Do not ramp: the hardware has cut the motors, or the robot touches an obstacle.
            state.cut()
            state.draft.made_of, state.draft.pressed_ns = None, now_ns
        if estop.driver_fault:
            self._fault(DRIVER_FAULT_REASON, now, events)
            life.freed_ns = now_ns
        if inputs.battery.stopped_now:
            life.press(empty_reason(config.battery), now)
        if state.session.status.forgot:
            inputs.forget(config)
        if inputs.battery.level != state.status.battery:
            state.arbiter.until_ns = 0  # to state it
        life.hold(inputs.clear_refusal(state.session, config), now_ns)

    def _choose(self, now_ns: Ns) -> None:
        state = self.state
        state.choice = state.arbiter.choose(now_ns, self.config.commands)
        if state.inputs.bumpers.limiting(self.config.safety):
            self._limit_by_bumpers(now_ns)
        state.life.command(state.choice.twist is not None)

    def _limit_by_bumpers(self, now_ns: Ns) -> None:
        state = self.state
        # If no motion remains, each sender must send a zero, or the robot would drive against the
        # obstacle as soon as the bumper is released.
        twist = state.choice.twist
        if twist is None:
            return
        away = state.inputs.bumpers.away(twist, self.config.safety)
        if away is None:
            state.arbiter.require_neutral(now_ns)
            # `require_neutral` has discarded all commands, so the new choice has no twist.
            state.choice = state.arbiter.choose(now_ns, self.config.commands)
        elif away != twist:
            state.choice = replace(state.choice, twist=away)

    def _is_plausible(self, line: Line, now: Instant, events: list[Event]) -> bool:
        state = self.state
        why = state.sanity.impossible(line, self.config.feedback.wheel_speed, self.model.names)
        if state.sanity.warning is not None:
            events.append(state.sanity.warning)
        if not why:
            return True
        state.count("line_implausible")
        events.append(
            Event("lines_rejected", why, "warning", kind="implausible", count=1, news=False)
        )
        state.odometry.skipped.add(line)
        if state.sanity.failed:
            cause = f"{why}; {UNDECLARED}" if state.session.coarse_lines else why
            self._fault(reason("impossible_speeds", cause=cause), now, events)
        return False

    def _check_and_integrate(self, line: Line, now: Instant, events: list[Event]) -> Estimate:
        state = self.state
        checks = state.checks
        wheels = checks.wheels
        # While the emergency stop is pressed, the motors may have no power, so wheels that do not
        # follow the commanded speeds are not a sign of a fault. Its silence tells nothing of them.
        estop = state.inputs.estop
        pressed = estop.state == "pressed" or estop.pressed_now == PRESSED_REASON
        # Without a link the board hears nothing, and must stop the motors.
        speeds = state.out.speeds if state.session.link == "up" else STILL
        wheels.commanded = None if pressed else speeds
        # Nobody knows which commands the board got in a silence, or while this computer was late.
        passed = line.dt + line.gap
        silent = passed > self.link_setup.covered_s
        late = silent or state.session.steps.step_s > WRITE_PAUSE_S
        wheels.unseen = passed if late else 0.0
        doubts = state.odometry.doubts
        doubted = doubts.differs
        estimate = state.odometry.fold(line, checks, self.model)
        if doubts.differs and not doubted:
            why = sentence("wheels_and_commands_differ")
            events.append(Event("pose_doubtful", why.text, "warning", code=why.code))
        if wheels.fault is not None:
            self._fault(wheels.fault, now, events)
        if wheels.gives_up:
            state.arbiter.require_neutral(now.mono_ns)
        if wheels.pushed:
            state.count("uncommanded_motion")
            events.append(Event("uncommanded_motion", wheels.pushed, "warning"))
        if wheels.events:
            state.count("wheel_faults", len(wheels.events))
        events += checks.events
        return estimate

    # Requests.

    def _serve(self, now: Instant, heard: Heard, events: list[Event]) -> tuple[Answer, ...]:
        state = self.state
        trip, state.draft.trip = state.draft.trip, ""
        if trip:
            self._fault(reason(trip), now, events)
            state.life.freed_ns = now.mono_ns
        if heard.shutting_down and state.life.mode is not Mode.SHUTDOWN:
            state.life.leave()
        answers: tuple[Answer, ...] = ()
        for request in heard.requests:
            answers += (self._answer(request, now, events),)
        return answers

    def _answer(self, request: Request, now: Instant, events: list[Event]) -> Answer:
        state = self.state
        mode, changes = state.life.mode, Changes()
        try:
            message, numbers = self._execute(request, now, changes)
        except RefusedError as refusal:
            return Answer(request.id, False, str(refusal))
        asked = (request.verb, request.by, request.asked_ns)
        if asked != state.request or request.asked_ns is None:
            news = state.life.mode is not mode or request.verb == "set"
            events.append(Event(request.verb, message, by=request.by, news=news))
        state.request = asked
        loan = state.life.loan if request.release_port else None
        return Answer(request.id, True, message, numbers, changes, loan)

    def _execute(
        self, request: Request, now: Instant, changes: Changes
    ) -> tuple[str, tuple[int, ...]]:
        state = self.state
        # Return the message and the numbers of the causes that were latched or released.
        life = state.life
        asked_ns = now.mono_ns if request.asked_ns is None else request.asked_ns
        match request.verb:
            case "stop":
                message = life.stop(request.by, asked_ns, now)
                return message, life.stop_of(request.by)
            case "clear":
                message, numbers = life.clear(request.numbers, asked_ns)
                if numbers:
                    state.sanity.forget()
                    state.checks.wheels.forget()
                    if not life.latches.of("stop"):
                        state.inputs.estop.powered()
                    state.arbiter.require_neutral(asked_ns)
                return message, numbers
            case "activate":
                if life.loan in (request.numbers or ()):
                    life.loan = 0  # even if the rest is refused
                numbers = life.activate(request.numbers, asked_ns)
                life.loan = 0
                state.arbiter.forget_clocks()
                state.arbiter.require_neutral(asked_ns)
                return "active", numbers
            case "deactivate" if request.release_port:
                return self._release_port(request.by, now)
            case "deactivate":
                message = life.deactivate(request.by, now)
                return message, (life.latches.last,)
            case "set_pose" | "reset_odometry":
                return self.place(request.pose or Pose(), now.mono_ns), ()
            case "set":
                changes |= self._set(request.settings, now.mono_ns)
                return describe_changes(changes) or NOTHING_CHANGED, ()
            case _:
                assert_never(request.verb)

    def _release_port(self, by: str, now: Instant) -> tuple[str, tuple[int, ...]]:
        state = self.state
        if self.config.mcu.simulated:
            raise RefusedError("the built-in simulator has no serial port")
        if not self._at_rest or self._rolls(now.mono_ns):
            raise RefusedError("the port is released only while the robot rests")
        if state.life.loan:
            raise RefusedError(ALREADY_LENT)
        numbers: tuple[int, ...] = ()
        if state.life.mode not in (Mode.STOPPED, Mode.FAULT, Mode.INACTIVE):
            state.life.deactivate(by, now)
            numbers = (state.life.latches.last,)
        state.checks.gyro.rest_s = 0.0
        state.life.lend()
        return PORT_LENT, numbers

    @property
    def _at_rest(self) -> bool:
        # Two lines are zero: the last one that left, which the wheels follow, and the last one that
        # was computed.
        return self.speeds == STILL and self.state.out.motion.twist == REST

    def _rolls(self, now_ns: Ns) -> bool:
        state = self.state
        # The wheels may still turn after the line of zeros, or somebody pushes the robot.
        speed = max(map(abs, state.odometry.speeds.as_tuple())) * self.model.kinematics.radius
        return not state.session.silent(now_ns) and speed > LEAST_SPEED

    def place(self, pose: Pose, at_ns: Ns) -> str:
        state = self.state
        state.odometry.set_pose(pose, self.model, at_ns)
        state.count("poses_set")
        state.checks.gyro.forget_doubt()
        pose = state.odometry.pose
        return f"pose is x {pose.x:g}, y {pose.y:g}, yaw {pose.yaw:g}"

    def _set(self, settings: dict[str, Plain], now_ns: Ns) -> Changes:
        before = self.config
        try:
            self.config, changes = changed(before, settings, self._at_rest)
        except ConfigError as error:
            raise RefusedError(str(error)) from None
        self.model = error_model(self.config)
        if self.config.commands != before.commands:
            self.state.arbiter.require_neutral(now_ns)
        return changes

    def _fault(self, why: Reason, now: Instant, events: list[Event]) -> None:
        state = self.state
        if state.life.fault(why, now):
            state.arbiter.require_neutral(state.draft.made_ns)
            text = f"{why.text}; `acsard call clear` releases it"
            events.append(Event("fault", text, "error", code=why.code))

    # Commands.

    def _accept_commands(self, now_ns: Ns, heard: Heard, events: list[Event]) -> None:
        state = self.state
        messages: Sequence[Command | Refusal] = heard.commands
        senders = {(command.source, command.sender) for command in heard.commands}
        if superseded := len(heard.commands) - len(senders):
            state.count("commands_superseded", superseded)
        if heard.refusals:
            # Process commands and refusals in the order of arrival. A message that is unreadable or
            # was lost may have commanded motion, so it cancels a zero that arrived before it.
            messages = sorted([*messages, *heard.refusals], key=lambda message: message.arrived_ns)
        for message in messages:
            if isinstance(message, Refusal):
                self._refuse(message, now_ns, events)
                state.arbiter.notice(message.source, message.sender, message.arrived_ns)
                continue
            if message.stamp_replaced:
                state.count("stamps_replaced")
            why = state.arbiter.accept(message, self.config.commands)
            if why is not None:
                text = f"source {message.source}: {waiting(why).text}"
                code = cast("RefusalCode", why.what)
                refusal = Refusal(code, text, message.source, message.sender)
                self._refuse(refusal, now_ns, events)
            else:
                state.count("commands")

    def _refuse(self, refusal: Refusal, now_ns: Ns, events: list[Event]) -> None:
        state = self.state
        events.append(refused(refusal))
        # Every sender that stamps its commands is unproven at first. This is normal, so `state`
        # must not show it as a refusal.
        if refusal.reason == "unproven":
            state.count("commands_of_new_senders")
            return
        state.count(f"command_{refusal.reason}")
        state.refused = (refusal.text[:MAX_REFUSAL_LENGTH], now_ns)

    # Limits and kinematics.

    def _cap_speed(self, cap: SpeedCap, events: list[Event]) -> None:
        state = self.state
        before, state.cap = state.cap, cap
        if cap.speed == before.speed:
            return
        text = "the speed limit has ended" if cap.speed is None else f"{cap.speed:.3g} m/s"
        events.append(Event("speed_limit", text, by=cap.by, news=False))

    # Report.

    def _restate(self, port_trouble: str) -> None:
        state = self.state
        life, choice, session, inputs = state.life, state.choice, state.session, state.inputs
        why = reason_of(life, choice, session, self.link_setup, inputs, self.config, port_trouble)
        # Use `_value_`, because the property `value` of an enum runs Python code.
        mode, level = life.mode._value_, inputs.battery.level
        numbers = tuple([cause.number for cause in life.latches.causes])
        status = Status(mode, why.code, why.text, session.link, choice.source, level, numbers)
        if status != state.status:
            state.status = status
