"""The promises of the product, judged with the knowledge of all true events.

`Witness` knows when each command was really sent and when each stop and clear arrived, and it reads
the lines on the wire with separate code. It shares nothing with the product. Each rule follows the
manual and allows everything that the manual allows. The first broken rule raises `BrokenError` with
its name.

Times are true ns from the start. True time continues while the robot's clock stops in a suspend.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, deque
from typing import Any, get_args

from acsard.core.tables.link_codes import LinkCode
from acsard.core.tables.motor_codes import GUARD_DEFECTS, FaultCode
from acsard.core.tables.sender_codes import WaitCode
from acsard.core.tables.stop_codes import StopCode
from tests.simulate.ages import MARGIN_NS, Ages, Sender, Wish
from tests.simulate.jerk import STEP, Slope
from tests.simulate.roads import NS, Message, Sample
from tests.simulate.wiring import letters, line_pattern, wheels

ZERO = (0.0, 0.0, 0.0, 0.0)
RESTING = {*get_args(WaitCode), "no_command"} - {"nothing", "command", "senders"}
BUMPERS = {"bumper_away", "bumper_blocks"}

CODES = {
    "shutdown": {"shutting_down"},
    "fault": {*get_args(FaultCode)},
    "stopped": {*get_args(StopCode)},
    "inactive": {"switched_off", "not_activated"},
    "waiting": {*get_args(LinkCode), "emergency_stop_missing", "bumpers_missing"} - {"link_up"},
    "driving": {"commanded", "limits_zero", "zeros", *BUMPERS},
    "ready": RESTING | BUMPERS,
}
"""The codes that `state` may have in each mode."""

RAMP_NS = 300_000_000
"""Allowed beyond the longest ramp: a pause of the daemon this long stops the board by itself."""

WATCHDOG_NS = 300_000_000
"""A board stops its motors this long after the last line, so a robot starts over from rest."""

BLOCKED_NS = 500_000_000
"""Time after which the daemon must report that the kernel takes no line.

The board's own watchdog stops the motors before that.
"""

LATE_NS = 150_000_000
"""Allowed beyond a ramp from the speeds that were seen at its beginning."""

RAMPS_NS = NS // 2
"""A ramp of an orderly end that takes at most this time is not cut short."""

SILENT_NS = 10 * NS + MARGIN_NS
"""A sender without an accepted command for this time must send a zero again."""

WAITED_NS = NS // 10 - MARGIN_NS
"""Behind a stall, speeds without a stamp are refused for this time: they may have waited in it."""

KEPT_STALLS = 10
"""Stalls that are remembered: a short one may come within `WAITED_NS` behind a long one."""

PAUSE_NS = NS - MARGIN_NS
"""A silence of this length may arm a sender of a source whose senders pauses arm."""

LOOK_NS = 2 * NS
"""A call without numbers is refused for this time, in which its sender may not know the cause."""

HARMLESS = {
    "mute", "noise", "partial_line", "lost_replies", "lost_commands", "slow_reply", "ftdi",
    "stalls", "sparse_replies", "echo", "plain_only", "endless", "wrong_baud", "reset", "suspend",
    "flip",
}  # fmt: skip
"""Troubles of the board for which the robot may not latch a fault."""

DIALECTS = {
    "unpadded", "spaces", "trailing_comma", "no_sample", "no_check", "constant_answers",
}  # fmt: skip
"""Forms of the protocol, and habits of the board, that give the daemon no trouble."""

INPUTS = {
    "estop", "estop_pressed", "estop_silent", "bumpers", "bumper_pressed", "bumpers_silent",
    "battery", "driver_fault",
}  # fmt: skip
"""Faults of the simulated board that report inputs. They give no trouble to lines and wheels."""

MAYBE_SPEEDS = ("garbage", "not a number", "huge", "fields")
"""Refused messages that may have been speeds of a program that shares its identity, so a zero of
this identity before them arms nobody."""


class BrokenError(AssertionError):
    """Raised when the product breaks a promise."""

    def __init__(self, promise: str, at_ns: int, text: str) -> None:
        super().__init__(f"{promise} at {at_ns / NS:.3f} s: {text}")
        self.promise, self.at_ns, self.text = promise, at_ns, text


class Witness:
    """Compares every line and every step with the true events."""

    def __init__(self, config: dict[str, Any]) -> None:
        self.config = config
        drive = config.get("drive", {})
        radius = drive.get("wheel_radius", 0.05)
        self.radii = tuple(
            radius * drive.get(f"{side}_wheel_radius_multiplier", 1.0) for side in ("right", "left")
        )
        self.radius = sum(self.radii) / 2
        # A robot that looks for 5 cm/s with encoders of 16 counts needs so long.
        self._rests_ns = int((1.0 + 20.0 * self.radius) * NS)
        self.half = (
            drive.get("wheel_separation", 0.3) * drive.get("wheel_separation_multiplier", 1.0) / 2
        )
        self.line_pattern, self._letters = line_pattern(config), letters(config)
        driven = [
            (name, self._letters.index(motor[1]), -1 if motor[0] == "-" else 1)
            for name, motor in wheels(config).items()
        ]
        if len(driven) == 2:
            driven += driven[::-1]
        self.names = [name for name, *_ in driven]
        """Name of each of the four wheels, and then the number and the sign of its motor."""
        self.motors = [(motor, sign) for _, motor, sign in driven]
        self.file = dict(config["limits"])
        self.limits = dict(config["limits"])
        commands = config["commands"]
        self.pausing = {
            s["name"] for s in commands["sources"] if s.get("neutral_first", "zero") == "pause"
        }
        """Sources whose senders a silence of one second arms."""
        self.priority = {s["name"]: s["priority"] for s in commands["sources"]}
        self.file_timeout = {s["name"]: int(s["timeout"] * NS) for s in commands["sources"]}
        rate = config["control"].get("rate", 100.0)
        if rate == "auto":
            rate = 100.0  # at 115200 baud the longest line allows more
        self.period_ns = int(NS / rate)
        quiet = max(0.1, 4 / rate, 3 * config["mcu"].get("reply_period", 0.0))
        self.quiet_ns = int(quiet * NS)
        self.counts: Counter[str] = Counter()
        self.shared_clocks: frozenset[str] = frozenset()
        """Clocks that several senders of the plan stamp by."""
        self.churned: set[str] = set()
        """Sources on which a program takes a new name for each message: it may fill their tables
        of senders."""
        self._stalls = [(-NS, -NS)]
        """Begin and end of the host's last stalls. Those that follow each other are one."""
        self.stops: list[int] = []
        """Arrivals of the stops that no clear has released."""
        self.perhaps_latched: set[str] = set()
        """Calls that may have to release a latch, which is not certain since the daemon ended."""
        self.offs: list[int] = []
        """Arrivals of each `deactivate` that no `activate` has released."""
        self.ending_ns: int | None = None
        """When the daemon got SIGTERM."""
        self.fault_ns: int | None = None
        self.perhaps_fault_ns: int | None = None
        """Time of a fault that the next daemon may have latched still, or not."""
        self.faults: list[int] = []
        """Times of the causes of the fault that no clear has released, as the log names them."""
        self.mode_ns = 0
        """Time of the last change of the mode."""
        self.away = False
        """Whether a bumper may be pressed that lets the robot only drive away."""
        self.driver_fault = False
        """Whether a line that this step has read may report a fault of a motor driver."""
        self.troubles: dict[str, int] = {}
        """Board faults and when each was last active."""
        self.lies: list[tuple[str, tuple[Any, ...]]] = []
        """The present faults of the board, without its lasting properties."""
        self.rested = True
        """Whether the robot has stood for a second since the last line that was no zero."""
        self._turns_ns = 0
        """When a wheel turned last, a line was no zero, or the daemon did not read the speeds."""
        self._wheels_ns = 0
        """When the daemon last read the speeds of the wheels."""
        self.blocked_ns: int | None = None
        """Since when the kernel takes no line."""
        self.braking: tuple[int, tuple[float, ...]] | None = None
        """When a robot that must not move was first seen to move, and its wheel speeds."""
        self._jerks = "linear_jerk" in self.limits
        """Jerk is limited: the plans limit it on both axes, or on none."""
        self.linked = True
        """The daemon says that the link to the board is up."""
        self.disarmed_ns = -1
        """Until then a command towards a pressed bumper, or a gap between lines with a check, may
        have disarmed every sender."""
        self.cut = False
        """The link was lost since the last line, so the speed starts over from zero."""
        self.pending: dict[str, int] = {}
        """The arrival of the latest call of each verb that waits for the disk with its answer, so
        it is not known yet whether it is in force."""
        self.mode = self.code = self.reason = self.source = ""
        self._decoded: dict[bytes, tuple[float, ...]] = {}
        self.new_life(0)

    # events

    def new_life(self, at_ns: int) -> None:
        """Note that the daemon started."""
        self.born_ns = at_ns
        self._stalls = [(-NS, -NS)]
        if self.blocked_ns is not None:
            self.blocked_ns = at_ns  # this daemon has not yet had the time to find that out
        self.timeout = dict(self.file_timeout)
        self.limits = dict(self.file)
        self.before = dict(self.limits)
        self.changed_ns = at_ns
        self.softest = dict(self.limits)
        self.armed_since_ns = at_ns
        self.ages = Ages(at_ns)
        self.senders: dict[tuple[str, str], Sender] = {}
        self._sharing: dict[str, list[Sender]] = {}
        """The shared identities of each source."""
        self.wishes: deque[tuple[str, Wish]] = deque()
        self._unread: list[tuple[str, Wish | None, tuple[Any, ...]]] = []
        """Messages that no step has read yet: the key, the command if it can be read, and the
        arguments for its age."""
        self._since_call: list[tuple[Wish, tuple[Any, ...]]] = []
        """Commands since the step that may execute the first call without an answer."""
        self._undone: list[list[tuple[Sender, list[tuple[int, int]]]]] = []
        """The zeros of other identities that each of them has cancelled."""
        self.last: tuple[float, ...] = ZERO
        self.last_ns = at_ns
        self.first = True
        """The next line is the first one since the port was opened: always a plain stop."""
        self.wished_ns = at_ns
        self.coasting: tuple[int, tuple[float, ...]] | None = None
        """Since when no wish explains the motion, and the wheel speeds then."""
        self._slopes = [Slope() for _ in range(4)]
        """Of the linear and then of the angular speed, forwards and backwards."""
        self.delivered = 0
        self.ending_ns = None
        self.mode = ""

    def command(
        self, sender: dict[str, Any], message: Message, sample: Sample, arrived_ns: int
    ) -> Wish | None:
        """Record a command that reached the daemon. Return None if it is not readable."""
        self.delivered += 1
        self._unread.append((sample.key, None, ()))
        self._undone.append([])
        source = sender["source"]
        if message.junk not in ("", "cancels"):
            unsure = self.senders.get((source, sample.identity))
            if unsure is not None and sample.shared and message.junk in MAYBE_SPEEDS:
                self._arm(unsure, arrived_ns)
                unsure.zeros.clear()
            return None
        if message.junk == "cancels":
            v, w = 0.0, 0.0
        else:
            v, w = message.v, message.w
        zero = v == w == 0.0 and message.junk == ""
        wish = Wish(arrived_ns, v, w)
        wish.identity, wish.shared = sample.identity, sample.shared
        arguments = sender, message, sample, arrived_ns, self.timeout[source]
        self._unread[-1] = sample.key, wish, arguments
        wish.certain = (
            not sample.clock and message.junk == "" and sender["way"] in ("plain", "bridge")
        )
        known = self.senders.get((source, sample.identity))
        if known is None:
            known = self.senders[source, sample.identity] = Sender()
            if sample.shared:
                self._sharing.setdefault(source, []).append(known)
        if arrived_ns - known.heard_ns > SILENT_NS:
            known.armed_ns = -1
            known.zeros.clear()
        numbered = not sample.shared and sender["way"] == "rmw"
        # Nothing was sent since a zero.
        follows = numbered and known.rests and message.number == known.number + 1
        if source in self.pausing and follows and arrived_ns - known.heard_ns > PAUSE_NS:
            known.armed_ns = arrived_ns
        if numbered and message.number > known.number:
            known.number, known.rests = message.number, zero
        waits = sample.shared or (source in self.pausing and sender["way"] == "rmw")
        known.heard_ns = arrived_ns
        late = sample.beat is not None and not self.ages.fresh(*arguments)
        if zero and late:
            pass  # it ends the speed of its sender, but arms nothing
        elif zero and not waits:
            known.armed_ns = arrived_ns
        elif zero:
            begun_ns, ended_ns = self._stalls[-1]
            stalled = begun_ns <= arrived_ns < ended_ns and ended_ns - begun_ns > LATE_NS
            known.zeros.append((ended_ns if stalled else arrived_ns, arrived_ns))
            del known.zeros[:-4000]
        elif sample.shared:
            self._cancel_zeros(source, arrived_ns, known)
        elif waits:
            self._arm(known, arrived_ns)
            known.zeros.clear()
        wish.armed_ns = known.armed_ns
        self.wishes.append((source, wish))
        return wish

    def dropped(self, key: str) -> None:
        """Note that the inbox dropped its oldest message on this key, so no step will read it.

        The robot does not follow this command, and does not learn its delay. It cancels zeros of
        its own identity only, because the robot does not know whether it was a speed.
        """
        place = next(n for n, (other, *_) in enumerate(self._unread) if other == key)
        del self._unread[place]
        for known, zeros in self._undone.pop(place):
            known.zeros[:0] = zeros

    def read(self, called: bool = False) -> None:
        """Judge the ages of all commands that a step has read. `called`: a call has no answer."""
        if not called:
            self._since_call.clear()
        self._since_call += [
            (wish, arguments) for _, wish, arguments in self._unread if wish is not None
        ]
        self._judge_ages()
        self._unread.clear()
        self._undone.clear()

    def _judge_ages(self) -> None:
        for place, (key, wish, arguments) in enumerate(self._unread):
            if wish is not None:
                wish.fresh = self.ages.fresh(*arguments) and not self.may_have_waited(wish)
                self._unread[place] = key, None, ()

    def may_have_waited(self, wish: Wish, surely: bool = True) -> bool:
        """Return whether a speed without a stamp arrived in a stall of the daemon or behind it.

        The daemon refuses it `surely`, or perhaps: it notes a stall at its next step.
        """
        room_ns = 0 if surely else 2 * MARGIN_NS + self.period_ns
        least_ns = LATE_NS + MARGIN_NS + self.period_ns - room_ns
        behind = any(
            ended_ns - begun_ns > least_ns
            and begun_ns < wish.arrived_ns < ended_ns + WAITED_NS + room_ns
            for begun_ns, ended_ns in self._stalls
        )
        return wish.certain and bool(wish.v or wish.w) and behind

    def _cancel_zeros(self, source: str, now_ns: int, sender: Sender) -> None:
        """Cancel the zeros of the source's shared identities, because one has sent a speed.

        Any program with that identity may have sent the speed.
        """
        for known in self._sharing.get(source, ()):
            self._arm(known, now_ns)
            if known is not sender and known.zeros:
                self._undone[-1].append((known, known.zeros.copy()))
            known.zeros.clear()

    def _arm(self, known: Sender, now_ns: int) -> None:
        """Arm a shared identity by its latest zero after which the neutral pause is over."""
        place = bisect_right(known.zeros, (now_ns - NS, now_ns))
        if place:
            known.armed_ns = max(known.armed_ns, known.zeros[place - 1][1])

    def arming(self, at_ns: int) -> None:
        """Note an event that disarms all senders, so that each must send a zero."""
        self.armed_since_ns = max(self.armed_since_ns, at_ns)

    def suspended(self, at_ns: int) -> None:
        """Note that the robot slept, so that it no longer knows the delays of the senders."""
        # The delays of the commands that wait for a step are of the time before.
        self._judge_ages()
        self.ages.forget_least(at_ns)

    def cleared(self, asked_ns: int, read_ns: int | None, text: str, name: str) -> None:
        """Note that the daemon has executed a clear, whose sender read the causes at `read_ns`.

        If others are left, it has released what its sender had read. Without a reading, it has
        released the faults.
        """
        if text.startswith("nothing"):
            return
        self.counts["clear"] += 1
        self.arming(asked_ns)
        left = text.startswith("cleared, but") and "type `acsard call clear` again" in text
        until_ns = read_ns if left and read_ns is not None else asked_ns
        newest_ns = max([*self.faults, *self.stops, self.fault_ns or 0])
        both = self.stops and self.fault_ns is not None
        if read_ns is None and not left and both and newest_ns < asked_ns:
            raise BrokenError("a plain clear releases the faults first", asked_ns, text)
        self._release(self.faults, "a clear releases no later fault", until_ns, read_ns, name)
        if self.fault_ns is not None and self.fault_ns <= until_ns:
            self.fault_ns = min(self.faults, default=None)
        if left and read_ns is None:
            if newest_ns <= asked_ns < newest_ns + LOOK_NS - MARGIN_NS:
                raise BrokenError("a clear releases no later stop", asked_ns, f"{name}: {text}")
            return
        self._release(self.stops, "a clear releases no later stop", until_ns, read_ns, name)
        if not left:
            self.perhaps_latched.discard("clear")

    def activated(self, asked_ns: int, read_ns: int | None, name: str) -> None:
        """Note that the daemon has executed an `activate`."""
        self.perhaps_latched.discard("activate")
        self.ages = Ages(asked_ns)
        for wish, arguments in self._since_call:  # a step executes its calls first
            wish.fresh |= self.ages.fresh(*arguments)
        self.arming(asked_ns)  # also if the robot was on
        self._release(self.offs, "an activate undoes no later one", asked_ns, read_ns, name)

    def _release(
        self, latched: list[int], promise: str, until_ns: int, read_ns: int | None, name: str
    ) -> None:
        # A stop that arrived behind the call stays latched. The answer may be later than both.
        later = [at_ns for at_ns in latched if at_ns > until_ns]
        for at_ns in latched[: len(latched) - len(later)]:
            known = read_ns is not None and read_ns >= at_ns
            # The sender may not know of a start.
            late = read_ns is None and until_ns >= max(at_ns, self.born_ns) + LOOK_NS - MARGIN_NS
            if not (known or late):
                text = f"the call of {name} released what was latched at {at_ns / NS:.3f} s"
                raise BrokenError(promise, until_ns, text)
        latched[:] = later

    def set_limits(self, at_ns: int, settings: dict[str, float], asked_ns: int) -> None:
        """Note settings that a `set` has changed. With a full disk its answer is late."""
        self.before, self.changed_ns = dict(self.limits), at_ns
        for key, value in settings.items():
            parts = key.split(".")
            if parts[0] == "limits":
                self.limits[parts[1]] = value
                low = self.softest.get(parts[1], value)
                self.softest[parts[1]] = (
                    min(low, value) if "deceleration" in key else max(low, value)
                )
                continue
            before_ns = self.timeout[parts[2]]
            self.timeout[parts[2]] = int(value * NS)
            if before_ns != self.timeout[parts[2]]:
                self.arming(asked_ns)

    def unanswered(self, verb: str, arrived_ns: int) -> None:
        """Note a call whose answer did not come before the daemon ended.

        After the restart the call may have an effect or not.
        """
        if verb in ("stop", "clear"):
            self.perhaps_latched.add("clear")
        elif verb in ("activate", "deactivate"):
            self.perhaps_latched.add("activate")
        match verb:
            case "stop":
                self.stops = [at_ns for at_ns in self.stops if at_ns != arrived_ns]
            case "clear":
                self.stops = [at_ns for at_ns in self.stops if at_ns > arrived_ns]
                self.faults = [at_ns for at_ns in self.faults if at_ns > arrived_ns]
                if self.fault_ns is not None and self.fault_ns <= arrived_ns:
                    self.perhaps_fault_ns, self.fault_ns = self.fault_ns, None
            case "activate":
                self.offs = [at_ns for at_ns in self.offs if at_ns > arrived_ns]

    def file_is_behind(self) -> None:
        """Note that the daemon ended before it could store its newest latches."""
        self.perhaps_latched |= {"clear", "activate"}
        self.stops.clear()
        self.offs.clear()
        self.faults.clear()
        self.perhaps_fault_ns = self.fault_ns or self.perhaps_fault_ns
        self.fault_ns = None

    def file_is_damaged(self, at_ns: int) -> None:
        """Note that a daemon cannot read the latch file, so it starts stopped."""
        self.file_is_behind()
        self.perhaps_fault_ns = None
        self.stops.append(at_ns)

    # the steps and lines of the daemon

    def step(
        self, at_ns: int, mode: str, code: str, reason: str = "", source: str = "", fed_ns: int = -1
    ) -> None:
        """Judge the mode and the code of its reason.

        The daemon last received bytes of a board at `fed_ns`.
        """
        if mode == "driving" and fed_ns >= 0:
            if self._silent(at_ns, fed_ns):
                text = f"last heard {fed_ns / NS:.3f} s"
                raise BrokenError("a silent board is not driven", at_ns, text)
            if self.blocked_ns is not None and at_ns - self.blocked_ns > BLOCKED_NS:
                text = f"no line left since {self.blocked_ns / NS:.3f} s"
                raise BrokenError("a blocked board is not driven", at_ns, text)
        if (mode, code, reason, source) == (self.mode, self.code, self.reason, self.source):
            return
        if code not in CODES.get(mode, ()) or not reason:
            raise BrokenError("every state has a reason", at_ns, f"{mode}: {code}: {reason!r}")
        if code in GUARD_DEFECTS:
            raise BrokenError("the guard never has to trip", at_ns, reason)
        if mode == "fault" != self.mode:
            self.counts["fault"] += 1
            recent = [k for k, last_ns in self.troubles.items() if at_ns - last_ns < 4 * NS]
            bounded = "is over feedback.wheel_speed" in reason
            if "pushed" in recent and self.last == ZERO and self.rested and not bounded:
                # A hand that turns wheels at rest is no fault, unless they seem to turn faster than
                # any wheel can. With coarse encoders, one count more is enough for that.
                recent.remove("pushed")
            # Echoes pass the lines that a stalled adapter holds, and contradict them.
            caused = not set(recent) <= HARMLESS or {"echo", "stalls"} <= set(recent)
            if code == "driver_fault":
                caused = self.driver_fault
            if self.mode and self.fault_ns is None and not caused:
                raise BrokenError("no fault without a cause", at_ns, f"{reason} (board: {recent})")
            if self.fault_ns is None:
                self.fault_ns = self.perhaps_fault_ns or at_ns
        if mode != self.mode:
            self.counts[f"mode {mode}"] += 1
            self.mode_ns = at_ns
        self.perhaps_fault_ns = None
        self.mode, self.code, self.reason, self.source = mode, code, reason, source

    @property
    def must_rest(self) -> tuple[int, str] | None:
        """The time since which the robot must not move, and the cause, or None."""
        causes = []
        if self.stops:
            causes.append((self.stops[0], "a stop"))
        if self.fault_ns is not None:
            causes.append((self.fault_ns, "a fault"))
        if self.offs:
            causes.append((self.offs[0], "being switched off"))
        if self.ending_ns is not None:
            causes.append((self.ending_ns, "SIGTERM"))
        return min(causes, default=None)

    @property
    def _must_surely_rest(self) -> tuple[int, str] | None:
        """Like `must_rest`, but without latches that a pending call may have released.

        A call is pending while the daemon waits for the disk.
        """
        if not self.pending:
            return self.must_rest
        cleared_ns, active_ns = self.pending.get("clear", -1), self.pending.get("activate", -1)
        causes = [(at_ns, "a stop") for at_ns in self.stops if at_ns > cleared_ns]
        if self.fault_ns is not None and self.fault_ns > cleared_ns:
            causes.append((self.fault_ns, "a fault"))
        causes += [(at_ns, "being switched off") for at_ns in self.offs if at_ns > active_ns]
        if self.ending_ns is not None:
            causes.append((self.ending_ns, "SIGTERM"))
        return min(causes, default=None)

    def ended(self, at_ns: int, moving: tuple[float, ...]) -> None:
        """Judge the orderly end of the daemon, which began at these wheel speeds.

        The daemon may cut the ramp short only if the ramp takes longer than the time for an orderly
        end.
        """
        begun_ns = self.ending_ns
        if begun_ns is None or self.blocked_ns is not None or self._stalls[-1][1] > begun_ns:
            return
        due_ns = self.ramp_ns(True, moving) + LATE_NS + self.period_ns
        if self.last != ZERO and self.linked and due_ns < RAMPS_NS:
            text = f"{self.last} is the last line, and the ramp takes {due_ns / NS:.3f} s"
            raise BrokenError("the last line of an orderly end is a zero", at_ns, text)

    def line(self, at_ns: int, line: bytes, fed_ns: int, made_ns: int) -> None:
        """Judge a line on the wire.

        Args:
            at_ns: Time at which the line left.
            line: The bytes of the line.
            fed_ns: Time at which the daemon last received bytes of the board.
            made_ns: Time of the step that made the line. The limits apply between such steps.
        """
        wheels = self._decoded.get(line) or self._read(at_ns, line)
        if wheels is None:
            return
        if self._jerks:
            self._jerk(at_ns, wheels, made_ns - self.last_ns)
        first, self.first = self.first, False
        if wheels == ZERO:
            if first and self.linked:
                # This stop has taken the place of a line, whose speed may have grown for longer.
                made_ns = self.last_ns
            self.last, self.last_ns, self.coasting, self.braking = ZERO, made_ns, None, None
            self.softest = dict(self.limits)
            return
        self.counts["moving lines"] += 1
        if at_ns - made_ns > self.period_ns + MARGIN_NS:
            text = f"{line!r} was made at {made_ns / NS:.3f} s"
            raise BrokenError("no line leaves later than it was made", at_ns, text)
        if not self.linked:
            raise BrokenError("only a linked board is driven", at_ns, f"{line!r}")
        if self._silent(at_ns, fed_ns):
            raise BrokenError(
                "a silent board gets zeros", at_ns, f"last heard {fed_ns / NS:.3f} s: {line!r}"
            )
        last_ns = self.last_ns
        before = ZERO if made_ns - last_ns > WATCHDOG_NS else self.last
        grows = any(
            abs(new) > abs(old) + 0.001 or new * old < 0.0
            for new, old in zip(wheels, before, strict=True)
        )
        if "set" not in self.pending:
            self._limits(at_ns, wheels, before, made_ns - last_ns, grows)
        hold = self._must_surely_rest
        if hold is None:
            self.braking = None
        else:
            self._check_rest(at_ns, hold, grows, line, wheels)
        self._wished(at_ns, wheels, before, grows, line)
        self.last, self.last_ns, self.cut, self.rested = wheels, made_ns, False, False

    def stalls(self, begun_ns: int, ended_ns: int) -> None:
        """Note a stall of the host. The steps after it read the bytes that arrived during it.

        The daemon reads no speeds during a stall, so the stall does not count as part of a pause.
        """
        lasts_ns = ended_ns - begun_ns
        if lasts_ns > LATE_NS:
            for known in self.senders.values():
                self._arm(known, begun_ns)
                known.zeros = [(ns + lasts_ns, arrived_ns) for ns, arrived_ns in known.zeros]
        before = self._stalls[-1]
        if begun_ns <= before[1]:
            begun_ns, ended_ns = before[0], max(before[1], ended_ns)
            del self._stalls[-1]
        self._stalls = [*self._stalls[-KEPT_STALLS:], (begun_ns, ended_ns)]

    def _silent(self, at_ns: int, fed_ns: int) -> bool:
        """Return whether the board has been silent for so long that the daemon must know it."""
        tolerance_ns = 2 * self.period_ns + MARGIN_NS
        begun_ns, ended_ns = self._stalls[-1]
        stalled = begun_ns <= at_ns < ended_ns + tolerance_ns
        return at_ns - fed_ns > self.quiet_ns + tolerance_ns and not stalled

    def _read(self, at_ns: int, line: bytes) -> tuple[float, ...] | None:
        """Return the wheel speeds of a line, None for a question to the board or a torn line."""
        match = self.line_pattern.match(line)
        if match is not None and not line.endswith(b"\n"):
            return None  # only its end is missing: the board may obey it, and the daemon says no
        if match is None:
            if line.endswith(b"\n") and line[:1] in (self._letters + "#").encode():
                raise BrokenError("every line is whole", at_ns, repr(line))
            return None
        motors = [float(g[1:]) * (1 if g[:1] == b"p" else -1) for g in match.groups()]
        wheels = tuple(motors[place] * sign + 0.0 for place, sign in self.motors)
        if len(self._decoded) > 20_000:
            self._decoded.clear()
        self._decoded[line] = wheels
        return wheels

    def twist(self, wheels: tuple[float, ...]) -> tuple[float, float]:
        """Return the speed (m/s) and turn rate (rad/s) for these wheel speeds (rad/s).

        The first two wheels are front right and front left.
        """
        right, left = self.radii[0] * wheels[0], self.radii[1] * wheels[1]
        return (right + left) / 2, (right - left) / (2 * self.half)

    def _most(self, name: str, at_ns: int) -> float:
        """Return a limit. Shortly after a change, return the larger of the old and new value."""
        value = self.limits[name]
        if at_ns - self.changed_ns < MARGIN_NS + self.period_ns:
            return float(max(value, self.before[name]))
        return float(value)

    def _most_limits(self, at_ns: int) -> dict[str, float]:
        """Return all limits. Shortly after a change, use the larger of the old and new values."""
        if at_ns - self.changed_ns < MARGIN_NS + self.period_ns:
            return {name: max(value, self.before[name]) for name, value in self.limits.items()}
        return self.limits

    def _limits(
        self, at_ns: int, wheels: tuple[float, ...], before: tuple[float, ...], dt: int, grows: bool
    ) -> None:
        if wheels[0] != wheels[3] or wheels[1] != wheels[2]:
            raise BrokenError("the wheels of a side turn alike", at_ns, str(wheels))
        limits, fastest = self._most_limits(at_ns), max(map(abs, wheels))
        most = limits["wheel_speed"] + 0.011
        if fastest > max(most, max(map(abs, before)) if not grows else 0.0):
            raise BrokenError("no wheel is over its limit", at_ns, f"{wheels} over {most:.2f}")
        (v, w), (v0, w0) = self.twist(wheels), self.twist(before)
        ev = self.radius * 0.011
        ew = self.radius * 0.011 / self.half
        seconds = min(dt / NS, max(0.05, 1.5 * self.period_ns / NS)) + 0.002
        for name, new, old, room in (("linear", v, v0, ev), ("angular", w, w0, ew)):
            speed = limits[f"{name}_speed"]
            if abs(new) > max(speed, abs(old)) + room:
                raise BrokenError("no speed is over its limit", at_ns, f"{name} {new:.4f}")
            down = limits[f"{name}_deceleration"]
            if self.mode in ("stopped", "fault", "shutdown"):
                down = max(down, limits[f"{name}_stop_deceleration"])
            falls = down * (dt / NS + 0.002) + 2 * room
            lost = abs(old) - abs(new) if new * old >= 0 else abs(old)
            up = limits[f"{name}_acceleration"]
            gained = abs(new) - abs(old) if new * old >= 0 else abs(new)
            too_much = (
                "deceleration" if lost > falls and not self.cut
                else "acceleration" if gained > up * seconds + 2 * room
                else ""
            )  # fmt: skip
            if too_much:
                raise BrokenError(
                    f"no {too_much} is over its limit", at_ns,
                    f"{name} {old:.4f} to {new:.4f} in {dt / NS:.4f} s",
                )  # fmt: skip

    def _jerk(self, at_ns: int, wheels: tuple[float, ...], dt: int) -> None:
        """Judge the change of the acceleration while a speed grows."""
        rim, longest_s = self._most("wheel_speed", at_ns), max(0.05, 1.5 * self.period_ns / NS)
        saturated = max(map(abs, wheels)) > rim - STEP or _fastest(self.last) > rim - STEP
        # A line that goes at once, or late, belongs to a step of another length than its interval.
        uneven = abs(dt - self.period_ns) > self.period_ns // 20
        lost = saturated or self.cut or "set" in self.pending or uneven
        room = 0.51 * STEP * self.radius
        slopes = iter(self._slopes)
        axes = zip(("linear", "angular"), self.twist(wheels), (room, room / self.half), strict=True)
        for name, speed, rounded in axes:
            up, jerk = self._most(f"{name}_acceleration", at_ns), f"{name}_jerk"
            unsure = lost or not self.limits.get(jerk)
            for sign in (1.0, -1.0):
                slope = next(slopes)
                if unsure or at_ns - self.changed_ns < MARGIN_NS + self.period_ns:
                    slope.lose(sign * speed, rounded, up)
                elif not slope.take(
                    sign * speed, min(dt / NS, longest_s), self.limits[jerk], up, rounded
                ):
                    raise BrokenError(
                        "no jerk is over its limit", at_ns,
                        f"{name} {speed:.4f} over {self.limits[jerk]:g}",
                    )  # fmt: skip

    def ramp_ns(self, stop: bool, wheels: tuple[float, ...] | None = None) -> int:
        """Return the longest time that a ramp to rest may take, in ns.

        It uses the lowest limits of this drive. The ramp begins at these wheel speeds, or at the
        highest possible ones.
        """
        low = self.softest
        rim = low["wheel_speed"] * self.radius
        linear, angular = min(low["linear_speed"], rim), min(low["angular_speed"], rim / self.half)
        if wheels is not None:
            v, w = self.twist(wheels)
            linear, angular = abs(v), abs(w)
        word = "stop_deceleration" if stop else "deceleration"
        return int(max(linear / low[f"linear_{word}"], angular / low[f"angular_{word}"]) * NS)

    def _check_rest(
        self,
        at_ns: int,
        hold: tuple[int, str],
        grows: bool,
        line: bytes,
        wheels: tuple[float, ...],
    ) -> None:
        since_ns, why = hold
        name = f"nothing moves after {why}"
        if grows and at_ns > since_ns + self.period_ns:
            raise BrokenError(name, at_ns, f"{line!r} grows, held since {since_ns / NS:.3f} s")
        first_ns, then = self.braking = self.braking or (at_ns, wheels)
        if at_ns - first_ns > 300_000_000 and _fastest(wheels) > _fastest(then) - 0.02:
            raise BrokenError(name, at_ns, f"{line!r} as fast as at {first_ns / NS:.3f} s")
        soft = why == "being switched off"
        if at_ns > since_ns + self.ramp_ns(not soft) + RAMP_NS + self.period_ns:
            raise BrokenError(name, at_ns, f"{line!r} still, held since {since_ns / NS:.3f} s")
        if at_ns > first_ns + self.ramp_ns(not soft, then) + LATE_NS + self.period_ns:
            text = f"{line!r} still, on a ramp from {then} at {first_ns / NS:.3f} s"
            raise BrokenError(name, at_ns, text)

    def wheels(self, at_ns: int, fastest: float) -> None:
        """Note the speed of the fastest true wheel, rad/s, and whether the robot sees it stand."""
        unseen, self._wheels_ns = at_ns - self._wheels_ns > NS // 2, at_ns
        unseen |= not self.linked
        if self.last != ZERO or fastest > 0.1 or unseen:
            self._turns_ns = at_ns
        self.rested |= at_ns - self._turns_ns > self._rests_ns

    def _wished(
        self,
        at_ns: int,
        wheels: tuple[float, ...],
        before: tuple[float, ...],
        grows: bool,
        line: bytes,
    ) -> None:
        if not grows and at_ns - self.wished_ns < 100_000_000:
            return
        wish, why = self._explains(at_ns, wheels, before, grows)
        if wish is not None:
            self.wished_ns, self.coasting = at_ns, None
            return
        if grows:
            raise BrokenError(
                "motion needs a fresh wish of an armed sender", at_ns, f"{line!r}: {why}"
            )
        since_ns, then = self.coasting = self.coasting or (at_ns, wheels)
        if at_ns - since_ns > 300_000_000 and _fastest(wheels) > _fastest(then) - 0.02:
            raise BrokenError("without a wish the robot slows down", at_ns, f"{line!r}: {why}")
        if at_ns - since_ns > self.ramp_ns(False, then) + LATE_NS + self.period_ns:
            raise BrokenError("without a wish the robot comes to rest", at_ns, f"{line!r}: {why}")

    def _explains(
        self, at_ns: int, wheels: tuple[float, ...], before: tuple[float, ...], grows: bool
    ) -> tuple[Wish | None, str]:
        """Return a command that allows this line, or None and why the latest one does not."""
        slack = self.period_ns + MARGIN_NS
        wishes, longest = self.wishes, max(self.timeout.values()) + slack
        while wishes and wishes[0][1].arrived_ns < at_ns - longest:
            wishes.popleft()
        why, lowest = "no command arrived within its timeout", self._lowest(at_ns)
        for source, wish in reversed(wishes):
            if wish.arrived_ns > at_ns or at_ns - wish.arrived_ns > self.timeout[source] + slack:
                continue
            if self.priority[source] < lowest:
                why = f"{source} has a lower priority than a source that sends"
                continue
            if not wish.fresh:
                why = f"{source} by {wish.identity} is stale"
                continue
            known = self.senders[source, wish.identity]
            armed_ns = wish.armed_ns
            if not wish.v and not wish.w:
                self._arm(known, at_ns)
                armed_ns = known.armed_ns
            if armed_ns < self.armed_since_ns:
                why = f"{source} by {wish.identity} is not armed"
                continue
            if not grows or "set" in self.pending or self._leads(wish, wheels, before):
                return wish, ""
            why = f"{source} by {wish.identity} wishes {wish.v:g}, {wish.w:g}"
        return None, why

    def _lowest(self, at_ns: int) -> int:
        """Return the lowest priority that may still drive: the highest one of the active sources.

        Only sources that certainly send now are counted.
        """
        if self.churned:
            return 0
        # A call without an answer may be in force.
        lowest, armed_ns = 0, max(self.armed_since_ns, self.disarmed_ns)
        since_ns = max(armed_ns, *self.pending.values(), 0)
        for source, wish in self.wishes:
            if wish.shared and (wish.armed_ns <= armed_ns or source in self.pausing):
                continue  # a zero of a shared identity counts only behind its pause
            age = at_ns - wish.arrived_ns
            live = 2 * MARGIN_NS < age < self.timeout[source] - self.period_ns - MARGIN_NS
            if live and wish.certain and wish.arrived_ns > since_ns + MARGIN_NS:
                lowest = max(lowest, self.priority[source])
        return lowest

    def _leads(self, wish: Wish, wheels: tuple[float, ...], before: tuple[float, ...]) -> bool:
        """Return whether the change from `before` to `wheels` approaches the commanded speeds."""
        if self.away and self._approaches(self.clamped(wish.v, 0.0), wheels, before):
            return True  # away from a bumper the robot does not turn
        return self._approaches(self.clamped(wish.v, wish.w), wheels, before)

    def _approaches(
        self, goal: tuple[float, float], wheels: tuple[float, ...], before: tuple[float, ...]
    ) -> bool:
        """Return whether no speed exceeds its goal or grows away from it."""
        for new, old, wished, room in zip(
            self.twist(wheels),
            self.twist(before),
            goal,
            (self.radius * 0.022, self.radius * 0.022 / self.half),
            strict=True,
        ):
            grew = abs(new) > abs(old) + room or (new * old < 0 and abs(new) > room)
            if grew and (wished * new <= 0 or abs(new) > abs(wished) + room):
                return False
        return True

    def clamped(
        self, v: float, w: float, limits: dict[str, float] | None = None
    ) -> tuple[float, float]:
        """Return commanded speeds scaled down to the limits, on the same curve.

        Without `limits` it uses the highest limits of this drive.
        """
        limits, scale = limits or self.softest, 1.0
        scale = min(scale, limits["linear_speed"] / abs(v) if v else 1.0)
        scale = min(scale, limits["angular_speed"] / abs(w) if w else 1.0)
        right, left = self.radii
        wheel = max(abs(v - w * self.half) / left, abs(v + w * self.half) / right)
        if wheel:
            scale = min(scale, limits["wheel_speed"] / wheel)
        return v * scale, w * scale


def _fastest(wheels: tuple[float, ...]) -> float:
    return max(map(abs, wheels))
