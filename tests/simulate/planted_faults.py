"""Small faults in the product's source, which `planted.py` plants one at a time.

A fault that only weakens the guard cannot be found, because the rest of the product never gives the
guard a line to replace. Two faults therefore weaken the guard and the part that it checks.
`CASES` are former defects by which the robot moved, or did not stop: each edit restores their code.
"""

from __future__ import annotations

from typing import NamedTuple


class Edit(NamedTuple):
    """A change in one module."""

    module: str
    old: str
    """Text that occurs exactly once in the module; if empty, `new` is added at the end."""
    new: str


PLANS_OF_FAULT = {
    "estop": "estop", "away": "away", "battery": "battery", "driver": "driver_fault",
    "moment": "late step", "robot set": "late step",
    "neutral stall": "stall behind a zero", "neutral resume": "stall",
    "driver release": "behind a press",
    "wheel press": "behind a press",
    "limits saturated": "wheel limit",
    "replay": "recorded", "lines endless": "endless", "wheel reversed": "reversed_motor",
    "wheel runaway": "slow wheels", "wheel fast": "gain",
    "wheel blocked": "dead_motor",
    "answers twice": "replies twice",
    "wheel stuck": "stuck encoder", "counts wrong": "wrong counts",
    "session gap": "mute", "session stale": "mute", "odometry silent": "mute",
    "odometry gap": "mute", "odometry lone": "flip", "sanity pause": "flip",
    "loop end": "restart", "robot end": "restart", "gate late": "stall in step",
    "session echo": "half_duplex", "session set points": "ideal board", "case 11": "echo",
    "limits clock": "wall",
    "robot unsent": "block", "robot limits": "limits", "lifecycle number": "typed",
    "lifecycle fault": "driver_fault", "ages echo": "queue from the start",
    "ages full": "short-lived publishers", "ages rise": "clock that is slewed",
    "neutral flicker": "dropouts",
    "gyro hangs": "hangs", "odometry still": "mute", "arbiter silence": "long silence",
    "two": "two wheels",
}  # fmt: skip
"""Kinds of plans by the name of a fault, or by the first word of its name."""


class Fault(NamedTuple):
    """A fault to plant: its name, its symptom and its edits."""

    name: str
    breaks: str
    """The symptom that a person would notice."""
    edits: tuple[Edit, ...]

    @property
    def kind(self) -> str:
        """The kind of plans that can find the fault, or "" for all plans.

        It is a kind of inputs, an event or one of its values, a fault of the board, a table of
        settings that a call changes, a moment of `bad_moments.py`, "recorded" or "two wheels".
        """
        first = self.name.split()[0]
        return PLANS_OF_FAULT.get(self.name) or PLANS_OF_FAULT.get(first, "")


def fault(name: str, breaks: str, module: str, old: str, new: str, *more: Edit) -> Fault:
    return Fault(name, breaks, (Edit(module, old, new), *more))


VALUES, GUARD, ROBOT = "core/values.py", "core/guard.py", "core/robot.py"
REASONS, INPUTS = "core/reasons.py", "core/board_inputs.py"
COMMANDS = "core/incoming/commands.py"
LOOP, PUBLICATION = "daemon/control_loop.py", "daemon/publication.py"
CODEC, SESSION = "core/link/codec.py", "core/link/session.py"
(
    AGES, ARBITER, BATTERY, BUMPERS, EMERGENCY_STOP, GYRO, KINEMATICS, LATCHES, LIFECYCLE, LIMITS,
    MODES, NEUTRAL, OBEDIENCE, ODOMETRY, UNCERTAINTY, WHEEL, WHEELS_LAW,
) = (
    f"core/motion/{name}.py"
    for name in (
        "ages", "arbiter", "battery", "bumpers", "emergency_stop", "gyro", "kinematics", "latches",
        "lifecycle", "limits", "modes", "neutral", "obedience", "odometry", "uncertainty", "wheel",
        "wheels",
    )
)  # fmt: skip

LINK_FIELD = "    _link: Link = field(default_factory=Link)\n"
"""A field of the session, behind which a fault adds one of its own."""

BLIND_GUARD = Edit(GUARD, 'return (self._stop, trip) if trip else (line, "")', 'return line, ""')
"""The guard passes every line."""

# fmt: off
FAULTS = (
    # guard
    fault("guard margin", "the guard stops a lawful ramp before its end", GUARD,
          "RAMP_MARGIN_NS = 300_000_000", "RAMP_MARGIN_NS = -100_000_000"),
    fault("guard timeout", "the guard replaces lines of a command that is still fresh", GUARD,
          "s.timeout * 1e9", "s.timeout * 3e8"),
    fault("guard wheel limit", "the guard replaces lines that are within the wheels' limit", GUARD,
          "limits.wheel_speed * 100 + 1", "limits.wheel_speed * 95"),
    fault("guard samples", "the guard refuses lines that ask for a sample", GUARD, "{2}S?", "{2}"),
    fault("guard and latch", "a stopped robot follows commands, and the guard lets it", ROBOT,
          "elif mode is Mode.DRIVING and twist is not None:", "elif twist is not None:",
          BLIND_GUARD),
    fault("guard and ramp", "a robot without a command keeps its speed, and the guard lets it",
          LIMITS, "share = 1.0 - dt / seconds if seconds > dt else 0.0", "share = 1.0",
          BLIND_GUARD),
    # arbiter
    fault("arbiter priority", "the source of the lowest priority wins", ARBITER,
          "                    -settings.priority,\n", "                    settings.priority,\n"),
    fault("arbiter arming", "a sender drives without having sent a zero", ARBITER,
          "if not (armed and sender.is_live(now_ns, timeout_ns(settings))):",
          "if not sender.is_live(now_ns, timeout_ns(settings)):"),
    fault("arbiter senders", "every new name of a sender takes memory for ever", ARBITER,
          "MAX_SENDERS = 16", "MAX_SENDERS = 1_000_000"),
    fault("arbiter timeout", "a command never times out", NEUTRAL,
          "return self.arrived_ns is not None and now_ns - self.arrived_ns <= timeout_ns",
          "return self.arrived_ns is not None",
          Edit(NEUTRAL, "now_ns - self.present_ns <= timeout_ns", "True")),
    fault("arbiter notice", "a zero arms a shared sender although unreadable speeds follow it",
          ARBITER, "            known.cancel_zero(arrived_ns)", "            pass"),
    fault("arbiter silence", "a zero that proved nothing counts although a long silence follows it",
          ARBITER, "if now_ns - sender.refused_ns > SILENT_NS:", "if False:"),
    fault("arbiter equal", "of two sources of equal priority the last that came takes the robot",
          ARBITER, "                    (settings.name, name) != self.holder,\n"
          "                    sender.came_ns,\n", "                    -sender.came_ns,\n"),
    fault("arbiter keeps", "a source of lower priority keeps the robot from one that comes later",
          ARBITER, "                rank = (\n",
          "                rank = (\n                    (settings.name, name) != self.holder,\n"),
    # neutral
    fault("moment older",
          "an older demand for a zero takes the place of a newer one that came in the same step",
          ARBITER, "self.since_ns = max(self.since_ns, since_ns)", "self.since_ns = since_ns"),
    fault("neutral pause", "a zero of a shared identity arms it after half the pause", NEUTRAL,
          "now_ns - self.zero_ns >= NEUTRAL_PAUSE_NS",
          "now_ns - self.zero_ns >= NEUTRAL_PAUSE_NS // 2"),
    fault("neutral again", "a sender stays armed when arming is asked for", NEUTRAL,
          "        self.arrived_ns = self.zero_ns = self.hint = None\n        self.armed = False\n",
          "        self.zero_ns = self.hint = None\n"),
    fault("neutral timeout", "a command counts for twice its timeout", NEUTRAL,
          "now_ns - self.arrived_ns <= timeout_ns", "now_ns - self.arrived_ns <= 2 * timeout_ns",
          Edit(NEUTRAL, "now_ns - self.present_ns <= timeout_ns",
          "now_ns - self.present_ns <= 2 * timeout_ns")),
    fault("neutral speeds", "speeds behind the zero of a shared identity do not undo it", ARBITER,
          "                    other.cancel_zero(now_ns)", "                    pass"),
    fault("neutral identities",
          "speeds behind the zero of a shared identity do not undo that of another one", ARBITER,
          "                    other.cancel_zero(now_ns)",
          "                    sender.cancel_zero(now_ns)"),
    fault("neutral session",
          "the zero of one program behind a router that stamps arms all of them at once", COMMANDS,
          "return Identity(name, arrival.stamp_ns, shared=True)\n    return",
          "return Identity(name, arrival.stamp_ns, shared=not arrival.sender)\n    return"),
    fault("neutral cancelled", "wheel speeds that cancel out arm like a zero", NEUTRAL,
          "return command.twist == REST and not command.cancelled", "return command.twist == REST"),
    fault("neutral never", "a zero arms no sender", NEUTRAL,
          "            self.armed = True\n        elif", "            pass\n        elif"),
    fault("neutral newest", "a newer command counts only when half of the timeout is over", NEUTRAL,
          "        self.twist, self.arrived_ns, self.present_ns = command.twist, now_ns, now_ns\n",
          "        if now_ns - (self.arrived_ns or 0) < timeout_ns // 2:\n            return\n"
          "        self.twist, self.arrived_ns, self.present_ns = command.twist, now_ns, now_ns\n"),
    fault("neutral stall", "a stall of the daemon counts as the pause after a zero", NEUTRAL,
          "        if self.zero_ns is not None:\n            self.zero_ns = now_ns\n", ""),
    fault("neutral resume", "a stall of the daemon asks each sender for a zero", NEUTRAL,
          "            self.present_ns = now_ns\n", "            self.arrived_ns = None\n"),
    fault("neutral gap", "a board that was silent for half a second asks each sender for a zero",
          SESSION, "LONG_GAP_NS = 1 * NS_PER_S", "LONG_GAP_NS = NS_PER_S // 2"),
    fault("neutral nothing", "a clear that finds nothing to release asks each sender for a zero",
          ROBOT, "                if numbers:\n                    state.sanity.forget()\n",
          "                state.arbiter.require_neutral(asked_ns)\n"
          "                if numbers:\n                    state.sanity.forget()\n"),
    fault("neutral overtaken", "a speed that arrives behind a later zero moves the robot", AGES,
          "if not verdict and last.overtook(command, timeout_ns):", "if False:"),
    fault("ages echo", "a command with an echo counts however late it is", AGES,
          "if age_ns > timeout_ns + MARGIN_NS:", "if age_ns > 10**12:"),
    fault("ages proof", "the second command of a new clock counts", AGES,
          "elif at_ns - self.since_ns >= timeout_ns:", "elif at_ns > self.since_ns:"),
    fault("ages silence", "a sender stays armed through any silence", NEUTRAL,
          "now_ns - self.arrived_ns > SILENT_NS", "now_ns - self.arrived_ns > 10**15"),
    fault("ages full", "a full table of clocks forgets one that it refuses", AGES,
          "return not self.late or now_ns - self.at_ns > MEMORY_NS", "return True",
          Edit(AGES, "(sound[n].least is not None,",
          "(not sound[n].late, sound[n].least is not None,"),
          Edit(AGES, "MAX_CLOCKS = 64", "MAX_CLOCKS = 16")),
    fault("ages rise", "the least delay of a clock rises by 5 % of the time, and without a bound",
          AGES, "RISE_DIVISOR = 2000", "RISE_DIVISOR = 20",
          Edit(AGES, "max(self.least, min(risen, min(self.lows) + timeout_ns))", "risen")),
    fault("neutral flicker", "a board that was silent for 0.12 s asks each sender for a zero",
          SESSION, "LONG_GAP_NS = 1 * NS_PER_S", "LONG_GAP_NS = 12 * NS_PER_S // 100"),
    fault("neutral anywhere", "a pause arms a sender of each source", ARBITER,
          "        if pauses:\n            sender.find_gap(command)\n",
          "        if True:\n            sender.find_gap(command)\n"),
    fault("neutral successor", "a pause arms although commands were lost in it", NEUTRAL,
          "self.rests and number(command) == self.number + 1", "self.rests"),
    fault("neutral goal", "a pause in the middle of a drive arms", NEUTRAL,
          "and self.rests and number(command)", "and number(command)"),
    fault("neutral late", "a newer command counts only after 60 ms", NEUTRAL,
          "        self.twist, self.arrived_ns, self.present_ns = command.twist, now_ns, now_ns\n",
          "        self.present_ns = now_ns\n"
          "        if self.arrived_ns is None or now_ns - self.arrived_ns > 60_000_000 or zero:\n"
          "            self.twist, self.arrived_ns = command.twist, now_ns\n"),
    # limits
    fault("limits stall", "the robot leaps after a stall", ROBOT,
          "dt = min(since, max(MAX_DT, 1.5 / self.config.rate_hz))", "dt = since"),
    fault("limits swapped", "the robot speeds up by its deceleration", LIMITS,
          "acceleration if abs(target) > abs(speed) else deceleration",
          "deceleration if abs(target) > abs(speed) else acceleration"),
    fault("limits speed", "a wish is not clamped to the limits", LIMITS,
          "return Twist(linear * scale, angular * scale)", "return Twist(linear, angular)"),
    fault("limits wheel", "the wheels are not held to their limit", KINEMATICS,
          "if fastest <= wheel_speed:", "if fastest <= 2 * wheel_speed:"),
    fault("limits ramp", "the ramp to rest takes twice as long as the deceleration says", LIMITS,
          "share = 1.0 - dt / seconds if", "share = 1.0 - dt / (2 * seconds) if"),
    fault("limits slow", "a robot that follows a slower command falls by half of its deceleration",
          LIMITS, "if abs(target) > abs(speed) else deceleration",
          "if abs(target) > abs(speed) else deceleration / 2"),
    fault("limits brake", "the robot always brakes by the stop deceleration", LIMITS,
          "    if stop:\n", "    if True:\n"),
    fault("limits curvature", "a wish over the limits loses its curvature", LIMITS,
          "return Twist(linear * scale, angular * scale)", "return Twist(linear * scale, angular)"),
    fault("limits below", "a robot at the limit of its wheels stays 0.05 rad/s below it", LIMITS,
          "_within_speed(wished, limits, cap), limits.wheel_speed)",
          "_within_speed(wished, limits, cap), limits.wheel_speed - 0.05)"),
    # modes and latches
    fault("modes stop", "a command drives the robot although it is stopped", MODES,
          "    if stopped:\n", "    if stopped and not commanded:\n"),
    fault("lifecycle number", "a clear that names an older cause releases the later ones, too",
          LIFECYCLE, "for cause in causes if cause.number in numbers]",
          "for cause in causes if cause.number >= min(numbers, default=2**60)]"),
    fault("lifecycle repeated", "a second stop does not get a number of its own", LIFECYCLE,
          "        if asked_ns > self.stop_asked_ns or not self.stop_of(by, or_others=newest):\n",
          "        if not self.stop_of(by, or_others=newest):\n"),
    fault("lifecycle fault", "a clear that names no cause releases a fault at once", LIFECYCLE,
          'self._require_shown(causes, asked_ns, "clear")',
          'self.latches.of("fault") or self._require_shown(causes, asked_ns, "clear")'),
    fault("lifecycle first", "a clear that names two causes releases only one of them", LIFECYCLE,
          "for cause in causes if cause.number in numbers]",
          "for cause in causes if cause.number in numbers][:1]"),
    fault("lifecycle more", "an activate releases a stop, too", LIFECYCLE,
          'return self._release(numbers, causes, "activate")',
          'stops = self.latches.of("stop", "inactive")\n'
          "        numbers = [*numbers, *[cause.number for cause in stops]]\n"
          '        return self._release(numbers, stops, "activate")'),
    fault("lifecycle shown", "a clear that names no cause works only after four seconds", LIFECYCLE,
          "SHOWN_S = 2.0", "SHOWN_S = 4.0"),
    fault("lifecycle off", "deactivate answers, but does nothing", LIFECYCLE,
          'self._use(latched(self.latches, "inactive", why, now.wall_ns, by))', "pass"),
    fault("limits jerk", "the robot speeds up at once, whatever jerk is allowed", LIMITS,
          "    if jerk and abs(target) > abs(speed):",
          "    if False and jerk and abs(target) > abs(speed):"),
    fault("limits clock", "a step of the wall clock stops a ramp, or makes it leap", ROBOT,
          "        since = (now_ns - out.made_ns) / NS_PER_S\n",
          "        since = (now.wall_ns - getattr(self, '_wall_ns', 0)) / NS_PER_S\n"
          "        self._wall_ns = now.wall_ns\n"),
    fault("limits saturated",
          "a robot that turns harder at the limit of its wheels brakes harder than it may", LIMITS,
          "return kinematics.saturate(fitted, most)", "return kinematics.saturate(twist, most)"),
    fault("kinematics curvature", "a robot at the limit of its wheels turns less than commanded",
          KINEMATICS, "return Twist(twist.linear * scale, twist.angular * scale)",
          "return Twist(twist.linear * scale, twist.angular * scale * scale)"),
    fault("kinematics curve", "the right wheels turn 0.03 rad/s too fast", KINEMATICS,
          "        return WheelSpeeds(right, left, left, right)",
          "        right += 0.03 if right else 0.0\n"
          "        return WheelSpeeds(right, left, left, right)"),
    fault("kinematics rear", "the rear wheels turn by 5 % slower than the front wheels", KINEMATICS,
          "        return WheelSpeeds(right, left, left, right)",
          "        return WheelSpeeds(right, left, 0.95 * left, 0.95 * right)"),
    fault("lifecycle seen", "an activate that names no cause works at once", LIFECYCLE,
          'self._require_shown(causes, asked_ns, "activate")', "pass"),
    fault("latches names", "a second stop replaces the name of the first client", LATCHES,
          "for cause in latches.causes if not _equal(cause, new)]",
          "for cause in latches.causes if cause.kind != kind]"),
    # robot
    fault("robot clear", "a clear asks no sender for a zero", ROBOT,
          "                    state.arbiter.require_neutral(asked_ns)\n"
          "                return message, numbers\n", "                return message, numbers\n"),
    fault("robot set", "new timeouts ask no sender for a zero", ROBOT,
          "            self.state.arbiter.require_neutral(now_ns)\n        return changes",
          "            pass\n        return changes"),
    fault("robot limits", "set answers, but the old limits stay in force", ROBOT,
          "        now_ns, twist, limits = now.mono_ns, state.choice.twist, self.config.limits\n",
          "        now_ns, twist, limits = now.mono_ns, state.choice.twist, self.config.limits\n"
          "        limits = self.__dict__.setdefault('_old_limits', limits)\n"),
    fault("robot reason", "a robot that stands says `no command`, whatever the cause is", REASONS,
          "why, limits = chosen(choice), config.limits",
          'why, limits = sentence("no_command"), config.limits'),
    fault("robot waits", "`state` names no source whose commands are late or not proved yet",
          ARBITER, "return self._refused(settings, now_ns) or COMMAND", "return COMMAND"),
    fault("robot unsent", "a line that never left counts as obeyed", ROBOT,
          "        draft.waits, draft.trip = False, trip\n",
          "        draft.waits, draft.trip = False, trip\n"
          "        line = line or self.link_setup.codec.encode(draft.speeds)\n"),
    # session
    fault("session quiet", "a silent board gets lines that move it for a second",
          "core/link/link_setup.py", "NS_PER_S * max(0.1, 4 / rate_hz",
          "NS_PER_S * max(1.0, 4 / rate_hz"),
    fault("times commands", "the time between two replies is twice that between their commands",
          "core/link/line_times.py", "= sample_ns - before if before else 0, 0",
          "= 2 * (sample_ns - before) if before else 0, 0"),
    fault("session stale", "a robot whose board is silent gets zeros and says `driving`", ROBOT,
          "state.life.link(up=False)", 'state.life.link(up=link == "stale")'),
    fault("session gap", "a gap of the feedback asks no sender for a zero", SESSION,
          "before_ns >= LONG_GAP_NS:", "before_ns >= 1000 * LONG_GAP_NS:"),
    fault("session reopened", "a port that was opened again asks no sender for a zero", SESSION,
          "        self.restarted = self.reopened = opened != self._opened\n",
          "        self.reopened = opened != self._opened\n"),
    fault("session unplugged", "the link stays up for half a second behind an unplugging", SESSION,
          "        if not port_open or opened != self._opened:",
          "        if (not port_open and self.silent(now.mono_ns - NS_PER_S // 2)) or (\n"
          "            opened != self._opened\n" "        ):"),
    fault("session first", "the first line to a board that was plugged in waits for a second",
          SESSION, "        if now_ns > self._link.silent_ns:\n",
          "        if now_ns - self._opened_ns < NS_PER_S:\n            return None\n"
          "        if now_ns > self._link.silent_ns:\n",
          Edit(SESSION, '        self._link.apply("opened" if port_open else "closed")',
          "        self._opened_ns = now_ns\n"
          '        self._link.apply("opened" if port_open else "closed")'),
          Edit(SESSION, LINK_FIELD, f"{LINK_FIELD}    _opened_ns: int = 0\n")),
    fault("session deaf", "behind a damaged line the next five lines are ignored", SESSION,
          "        if self._echo.trouble:\n            self._reject", "        self._deaf -= 1\n"
          "        if self._deaf > 0:\n            return None\n"
          "        if self._echo.trouble:\n            self._reject",
          Edit(SESSION, "self._link.bad(setup.checked)\n\n    def _check",
          "self._link.bad(setup.checked)\n            self._deaf = 6\n\n    def _check"),
          Edit(SESSION, LINK_FIELD, f"{LINK_FIELD}    _deaf: int = 0\n")),
    fault("gate late", "a line that was made before a stall leaves after it",
          "core/link/serial_output.py", "if now_ns - made_ns > self._period_ns and",
          "if False and"),
    fault("lines endless", "a line without an end fills the memory", "core/link/lines.py",
          "            if len(self.held) >= MAX_LINE_BYTES:", "            if False:"),
    fault("loop periods", "twice a second no line leaves for 60 ms", LOOP,
          "                if line is not None:\n",
          "                if line is not None and now.mono_ns % 500_000_000 >= 60_000_000:\n"),
    fault("loop disk", "no line leaves while the latch file cannot be written", LOOP,
          'if port.offer(line, now) != "sent":',
          'if self._keeper.trouble or port.offer(line, now) != "sent":'),
    fault("loop end", "SIGTERM ends the daemon while the robot moves", LOOP,
          "return self.robot.speeds == STILL", "return True"),
    fault("robot end", "the robot does not slow down on SIGTERM", ROBOT,
          "            state.life.leave()\n", "            pass\n"),
    fault("robot end reason", "`state` has no reason while the daemon ends", REASONS,
          "            return SHUTDOWN_REASON\n", '            return Reason("shutdown", "")\n'),
    fault("session mute", "a board that does not answer yet gets no lines", SESSION,
          "        if self._echo.due and out.lines",
          "        if self.silent(now_ns):\n            return None\n"
          "        if self._echo.due and out.lines"),
    fault("codec zeros", "a speed has one digit behind its point if it can", CODEC,
          "hundredths % 100:02d}", "hundredths % 100:d}"),
    fault("codec rim", "a wheel speed above 1 rad/s is written 0.03 rad/s too high", CODEC,
          "    direction = ", "    hundredths += 3 * (hundredths > 100)\n    direction = ",
          BLIND_GUARD),
    fault("session creep", "a board that does not answer is driven slowly", SESSION,
          "            speeds = STILL\n", "            speeds = WheelSpeeds(0.1, 0.1, 0.1, 0.1)\n",
          BLIND_GUARD),
    fault("output first",
          "the first line to a board that was plugged in is that of the robot, which moves",
          "core/link/serial_output.py", "goes = self._stop if self._first else line", "goes = line",
          Edit(SESSION, "            speeds = STILL\n",
          "            speeds = WheelSpeeds(0.1, 0.1, 0.1, 0.1)\n"), BLIND_GUARD),
    fault("session echo", "an echo beside the replies of a board is not noticed",
          "core/link/echo_check.py",
          "least = min(self.lines, RETURNED_FRACTION * (written - self.written))",
          "least = self.lines"),
    fault("session set points",
          "motors that repeat the first line of some ramps are taken for no encoders",
          "core/link/echo_check.py", "            self.ramps, self.asked_of_ramps = 0, False\n",
          "            pass\n"),
    # log
    fault("log flooded", "a client can fill the log", "core/motion/event_throttle.py", "BURST = 5",
          "BURST = 500"),
    fault("log modes", "the log does not have the changes of the mode",
          "core/motion/arbiter_text.py", "        if mode is not before:\n", "        if False:\n"),
    fault("log empty", "the line of the log about a link that is up has no text",
          "core/link/link_diagnosis.py", '"up": sentence("link_up"),',
          '"up": Reason("link_up", ""),'),
    # sanity
    fault("wheel runaway", "a wheel that rolls on after a stop is never a fault", WHEELS_LAW,
          "if wheel.obedience.unexplained >= least + wheel.timing:", "if False:"),
    fault("wheel fast", "a robot that is faster than its limiter is never a fault", WHEEL,
          "fast = self.fast_s >= TOO_FAST_S and", "fast = False and"),
    fault("wheel blocked", "a wheel that does not turn is not reported", WHEEL,
          "slow, beyond = min(self.obedience.slow),", "slow, beyond = 0.0,"),
    fault("wheel reversed", "a wheel that turns the wrong way is never a fault", WHEELS_LAW,
          'self._latch("wheel_reversed", i, command)', "pass"),
    # bus
    fault("bus reasons", "a message that is too big is counted as one that cannot be read",
          COMMANDS, '"too_big", f"{len(arrival.payload)} bytes are too many for a command"',
          '"malformed", f"{len(arrival.payload)} bytes are too many for a command"'),
    fault("bus answers", "a call that is refused has no answer", PUBLICATION,
          "            if reply is not None:\n                self.bus.reply(reply)\n"
          "                self.bus.retire",
          "            if reply is not None and answer.success:\n"
          "                self.bus.reply(reply)\n" "                self.bus.retire"),
    fault("commands raise", "a command that is too big raises an exception", COMMANDS,
        'raise DecodeError("too_big", f"{len(arrival.payload)} bytes are too many for a command")',
        'raise ValueError("too big")'),
    fault("bus counts", "commands of zero are not counted", ROBOT, 'state.count("commands")',
          'state.count("commands", message.twist != REST)'),
    # odometry
    fault("odometry turn", "the pose turns the wrong way", KINEMATICS,
          "(right - left) / self.track", "(left - right) / self.track"),
    # The simulated robot moves by the same `on_arc`, so the fault is where the odometry calls it.
    fault("odometry yaw", "the pose turns by a fifth too much", ODOMETRY,
          "on_arc(pose.yaw, way, turned)", "on_arc(pose.yaw, way, 1.2 * turned)"),
    fault("odometry set", "set_pose takes x for y", ODOMETRY,
          "self.pose = Pose(pose.x, pose.y, math", "self.pose = Pose(pose.y, pose.x, math"),
    fault("odometry gap", "a gap while the robot moves does not make the pose less certain",
          ODOMETRY, "            if gap:\n", "            if gap and gap.seconds > 1e9:\n"),
    fault("odometry lone", "a false speed behind a silence takes the doubt of another gap away",
          ODOMETRY, "uncertainty.doubt(distance**2, turns * angle**2, 0.0, heading)",
          'uncertainty.miss("gap", -distance, -turns * angle, heading)'),
    fault("sanity pause", "a damaged speed behind a pause makes the true ones impossible",
          "core/motion/sanity.py", "MAX_WHEEL_ACCELERATION * passed < fastest",
          "passed < math.inf"),
    fault("wheel silence", "what was smoothed before a long silence is motion behind it",
          "core/motion/wheels.py", "                wheel.stand()\n", "                pass\n"),
    fault("doubts more", "what the wheels did otherwise is in doubt three times",
          "core/motion/doubts.py", "        return Step((right, left, left, right), margin",
          "        left, right = 3.0 * left, 3.0 * right\n"
          "        return Step((right, left, left, right), margin"),
    fault("odometry vague", "the covariance of the pose is a hundred times as large as the errors",
        UNCERTAINTY, "        self.covariance = p if known else UNKNOWN_POSE\n",
        "        p = PoseCovariance(*(100.0 * getattr(p, name) for name in p.__struct_fields__))\n"
        "        self.covariance = p if known else UNKNOWN_POSE\n"),
    fault("odometry silent", "the pose goes on at 0.1 m/s while the board is silent", ROBOT,
          "        pressed = out.made_ns < draft.pressed_ns\n",
          "        pressed = out.made_ns < draft.pressed_ns\n"
          '        if state.session.link != "up" and state.session.good_lines:\n'
          "            pose = state.odometry.pose\n"
          "            state.odometry.pose = replace(pose, x=pose.x + 0.001)\n"),
    fault("odometry endless", "the covariance of a robot that has stood for 3 s is infinite",
          ODOMETRY, "        at_rest = self.rested > REST_S\n",
          "        at_rest = self.rested > REST_S\n" "        if self.rested > 3.0:\n"
          "            p = self.uncertainty.covariance\n"
          "            p = type(p)(math.inf, p.xy, p.xyaw, p.yy, p.yyaw, p.yawyaw)\n"
          "            self.uncertainty.covariance = p\n"),
    fault("odometry leap", "a lost line moves the pose by 2 m", ODOMETRY,
          "        self.filled += filled\n", "        self.filled += filled\n        if filled:\n"
          "            self.pose = Pose(self.pose.x + 2.0, self.pose.y, self.pose.yaw)\n"),
    # latch file
    fault("latches kept", "the latch file is never written", LOOP,
          "                keeper.keep(robot.latches)",
          "                keeper.latches = robot.latches"),
    fault("latches fault", "a fault is gone after a restart", LATCHES,
          "[replace(cause, kept=True) for cause in latches.causes]",
          '[replace(cause, kept=True) for cause in latches.causes if cause.kind != "fault"]'),
    # gyro
    fault("latches number", "a restart begins again to count the causes from 1",
          "daemon/latch_file.py",
          "return after_restart(Latches(causes, last + 1 + secrets.randbits(32)))",
          "return after_restart(Latches(causes, max([c.number for c in causes], default=0)))"),
    fault("odometry still", "behind a silence the heading of a robot that stands is 0.3 rad off",
          ODOMETRY, "        self.travelled += abs(distance)\n",
          "        angle += 0.3 if gap and at_rest and gap.seconds + gap.unknown > 0.1 else 0.0\n"
          "        self.travelled += abs(distance)\n"),
    fault("odometry wraps", "x of the pose goes from 1 m to -1 m", ODOMETRY,
          "self.pose = Pose(pose.x + dx, pose.y + dy, yaw)",
          "self.pose = Pose(math.remainder(pose.x + dx, 2.0), pose.y + dy, yaw)"),
    fault("answers twice", "replies that arrive twice never let the link come up",
          "core/link/link_output.py", "again = reply.sequence in self.answered", "again = False",
          Edit("core/link/link_state.py", "CHECKED_LINES = 3, 1", "CHECKED_LINES = 3, 2")),
    fault("wheel stuck", "a wheel that seems not to turn is neither left out nor named",
          "core/motion/sides.py", "OUT_BLOCKS = 2\n", "OUT_BLOCKS = 1_000_000\n",
          Edit(WHEEL, "slow, beyond = min(self.obedience.slow), min(self.obedience.fast)",
          "slow = beyond = 0.0")),
    fault("counts wrong", "counts that contradict the speeds of their lines are believed",
          "core/link/board_counts.py", "= 0.03, 2, 0.005, 0.25", "= 30.0, 2, 0.005, 0.25"),
    fault("gyro hangs", "a gyro that repeats one rate is believed", GYRO,
          "self.hangs |= share < MAX_REPEATING and", "self.hangs |= share < 0.0 and"),
    # two driven wheels
    fault("two rear", "of two wheels, each rear one turns like the wheel of the other side", CODEC,
          "[*motor_of, *motor_of[::-1]]", "[*motor_of, *motor_of]"),
    fault("two names", "of two wheels, one that does not turn is named like one of four", VALUES,
          "WHEELS if count == len(WHEELS) else TWO_WHEELS", "WHEELS[:count]"),
    fault("two counts", "replies of two motors with their counts are not read",
          "core/link/checked_line.py", "{20}|[0-9A-F]{12}))?", "{20}))?"),
    # recording
    fault("replay clock", "the pose depends on a clock that the inputs do not have", ODOMETRY,
          "        self.travelled += abs(distance)\n", "        self.travelled += abs(distance)\n"
          '        distance += __import__("time").perf_counter_ns() % 2 * 1e-9\n'),
    fault("replay state", "the state at the start of a recording has another heading",
          "recording/state.py", "        frozen = _frozen.decode(data)\n",
          "        frozen = _frozen.decode(data)\n        pose = frozen.state.odometry.pose\n"
          "        frozen.state.odometry.pose = type(pose)(pose.x, pose.y, pose.yaw + 0.001)\n"),
    # inputs of the board
    fault("driver ignored",
          "a fault of a motor driver that the board reports does not stop the robot", ROBOT,
          "        if estop.driver_fault:\n",
          "        if not estop.is_pressed and estop.pressed_now:\n"),
    fault("driver clear", "a clear works while a motor driver has a fault", INPUTS,
          "        if session.status.last.driver_fault:\n",
          "        if session.status.last.driver_fault and self.estop.is_pressed:\n"),
    fault("driver without power", "a pressed emergency stop latches a fault of the motor drivers",
          ROBOT, "        if estop.driver_fault:\n",
          "        if any(status.driver_fault for _, status in state.session.status.new):\n"),
    fault("driver release", "drivers that get their power later than the release latch a fault",
          EMERGENCY_STOP, "not (pressed or self.unpowered)", "not pressed"),
    fault("wheel press",
          "a wheel that rested during a press and is then turned by hand is a runaway", WHEELS_LAW,
          "                wheel.rest(angle, block)\n        elif s:",
          "                pass\n        elif s:"),
    fault("driver cut", "a fault of a motor driver stops the robot without a ramp", ROBOT,
        "            self._fault(DRIVER_FAULT_REASON, now, events)\n",
        "            self._fault(DRIVER_FAULT_REASON, now, events)\n"
        "            state.cut()\n"),
    fault("estop ramp", "a robot whose emergency stop is pressed ramps down", ROBOT,
          "        if estop.pressed_now is not None or bumpers.pressed_now is not None:\n",
          "        if bumpers.pressed_now is not None:\n"),
    fault("estop latch", "a robot drives again as soon as its emergency stop is released", ROBOT,
          "            life.press(estop.pressed_now, now)\n",
          "            state.arbiter.require_neutral(now_ns)\n"),
    fault("estop short", "a press that begins and ends during a stall of the host is not seen",
          EMERGENCY_STOP, "        for at_ns, status in reports:\n",
          "        for at_ns, status in [*reports][-1:]:\n"),
    fault("estop late", "a pressed emergency stop waits up to 25 ms for its first zero", LOOP,
          "            if due:\n                line = robot.drive(now)\n",
          "            pressed = robot.state.inputs.estop.is_pressed\n"
          "            late = pressed and now.mono_ns % 10**8 < 25 * 10**6\n"
          "            due = due and not late\n"
          "            if due:\n                line = robot.drive(now)\n",
          Edit(LOOP, "None, news.urgent,", "None, news.urgent and not late,")),
    fault("estop clear", "a clear works while the emergency stop is pressed", LIFECYCLE,
          "        if self.held:\n", "        if False:\n"),
    fault("estop silent", "a robot drives for 2 s without reports of its emergency stop",
          EMERGENCY_STOP, "SILENCE_TIMEOUT_S = 0.5", "SILENCE_TIMEOUT_S = 2.0"),
    fault("estop hasty", "two lost status lines stop the robot", EMERGENCY_STOP,
          "SILENCE_TIMEOUT_S = 0.5", "SILENCE_TIMEOUT_S = 0.25"),
    fault("estop needed", "a robot is ready before its board has reported the inputs that it needs",
          ROBOT, "            state.life.link(up=not inputs.missing(safety))\n",
          "            state.life.link(up=True)\n"),
    fault("estop state", "`state` calls a pressed emergency stop released",
          "core/summary.py", "            emergency_stop=inputs.estop.state,\n",
          '            emergency_stop="released" if inputs.estop.state else "",\n'),
    fault("away towards", "a robot drives towards its pressed bumper", BUMPERS,
          '{"front": -1, "rear": 1, ', '{"front": 1, "rear": -1, '),
    fault("away fast", "a robot drives away from its bumper at 0.3 m/s", BUMPERS,
          "AWAY_SPEED = 0.1", "AWAY_SPEED = 0.3"),
    fault("away turns", "a corner of the robot sweeps into the obstacle while it drives away",
          BUMPERS, "return Twist(direction * min(speed, AWAY_SPEED)) if",
          "return Twist(direction * min(speed, AWAY_SPEED), twist.angular) if"),
    fault("away pushes",
          "a sender that pushes against the obstacle drives on at the release of the bumper", ROBOT,
          "            state.arbiter.require_neutral(now_ns)\n            # `require_neutral` has "
          "discarded all commands, so the new choice has no twist.\n            state.choice = "
          "state.arbiter.choose(now_ns, self.config.commands)\n",
          "            state.choice = Choice()\n"),
    fault("away silent",
          "a robot that may drive away from its bumpers drives on without reports of them", BUMPERS,
          'return self.state == "silent" or not _drives_away(safety)',
          "return not _drives_away(safety)"),
    fault("away ramp", "a bumper that lets the robot drive away stops it with a ramp", ROBOT,
          "if estop.pressed_now is not None or bumpers.pressed_now is not None:",
          "if estop.pressed_now is not None or (\n"
          "            bumpers.pressed_now is not None and bumpers.latching(config.safety)\n"
          "        ):"),
    fault("battery stop", "an empty battery does not stop the robot", ROBOT,
          "        if inputs.battery.stopped_now:\n", "        if False:\n"),
    fault("battery cut", "an empty battery stops the robot without a ramp", ROBOT,
        "            life.press(empty_reason(config.battery), now)\n",
        "            life.press(empty_reason(config.battery), now)\n"
        "            state.cut()\n"),
    fault("battery start", "the current of a motor start changes the level of the battery", BATTERY,
          "TIME_CONSTANT_S = 10.0\n", "TIME_CONSTANT_S = 0.5\n"),
    fault("battery clear", "a clear works while the battery is empty", INPUTS,
          "if self.battery.refuses_clear else awaited", "if False else awaited"),
    fault("battery level", "the level of the battery rises as soon as the motors stop", BATTERY,
          "            rise = HYSTERESIS if", "            rise = 0.0 if"),
)

CASES = (
    fault("case 1", "a restart releases a stop, a fault and `inactive`", LATCHES,
          "[replace(cause, kept=True) for cause in latches.causes]", "[]"),
    fault("case 2", "the first zero of a shared sender arms it", NEUTRAL,
          "        if not (zero and waits):\n            self.armed = True",
          "        if True:\n            self.armed = True"),
    fault("case 3", "a congested link is taken for a clock that was adjusted", AGES,
          "        if least is None or delay < least - MARGIN_NS:\n",
          "        if least is None or abs(delay - least) > timeout_ns:\n"),
    fault("case 4", "the output was blocked for minutes, and then the robot drives on", SESSION,
          "            self.blocked = True\n", "            self.blocked = False\n"),
    fault("case 5", "an older command after a newer one is obeyed", AGES,
          "if not verdict and stamp_ns <= self.accepted_ns:", "if False:",
          Edit(AGES, "<= (self.beat_ns, self.sequence):", "<= (-1, -1):")),
    fault("case 6", "the guard does not check that a stopped robot comes to rest, and it does not",
          GUARD, "if self._late(now_ns):", "if False:",
          Edit(LIMITS, "share = 1.0 - dt / seconds if seconds > dt else 0.0",
          "share = 1.0 if stop else 1.0 - dt / seconds if seconds > dt else 0.0")),
    fault("case 7", "a clear that was sent before a stop and arrives after it releases that stop",
          LIFECYCLE, "SHOWN_S = 2.0", "SHOWN_S = 0.0",
          Edit(LIFECYCLE, "for cause in causes if cause.number in numbers]",
          "for cause in causes]")),
    fault("case 8", "one plain clear releases a fault and the stop below it", LIFECYCLE,
          'self.latches.of("fault") or causes]', "causes]"),
    fault("case 9", "healthy motors that lag latch the fault `runaway`", OBEDIENCE,
          "return min(self.astray)", "return self.astray[0]",
          Edit("core/motion/sides.py", "self.due.add(command, half, whole, ",
          "self.due.add(command, ")),
    fault("case 10", "`state` keeps the last speed when the link is gone",
          "core/summary.py", "silent = odometry.pose, session.silent(now_ns)",
          "silent = odometry.pose, False"),
    fault("case 11", "TX joined to RX looks like a board, and the daemon drives it",
          "core/link/echo_check.py", "            self.due = True\n\n\ndef",
          "            pass\n\n\ndef"),
)
# fmt: on
