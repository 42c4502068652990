"""Simulates the board: its side of the serial protocol, with the time of each byte on the wire.

It does not use the daemon's parser, so an error there makes tests fail. A test switches a fault on
for a `with` block, such as `with mcu.mute():` (`faults.py`); those of `[sim] faults` are always on.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count, cycle

from acsard.core.config.named_faults import named
from acsard.core.config.settings import Config, WheelMap
from acsard.core.config.wire_time import wire_ns
from acsard.core.simulator import protocol
from acsard.core.simulator.faults import USB_PACKET, Fault, Faults
from acsard.core.simulator.faults import WATCHDOG_NS as WATCHDOG_NS
from acsard.core.simulator.vehicle import Vehicle
from acsard.core.values import NS_PER_S, Ns

MS = 1_000_000

RESET_NS = 2 * NS_PER_S  # a board with a bootloader ignores its input after a reset

# A reply within this time after the last computation from encoder counts repeats its speeds.
MIN_WINDOW_NS = 4 * MS

OUTPUT_BYTES = 255  # bytes; a line that does not fit is dropped, as by `deploy/firmware`

STATUS_NS = NS_PER_S // 10

# Six cells: V of the empty battery, additional V of a full one, ohm.
EMPTY_VOLTS, CHARGED_VOLTS, RESISTANCE = 21.0, 4.2, 0.2

REST_AMPS, AMPS_PER_SPEED = 0.5, 0.05  # A at rest, and A for each rad/s of each wheel

START_AMPS, START_NS = 10.0, 300 * MS  # while the motors start; it lowers the voltage by 2 V

NEVER_NS = 2**62

# From the arrival of a line to the start of the reply, in turn.
PROCESSING_MS = (2.1, 1.3, 3.7, 1.0, 4.9, 2.6, 1.8, 3.2)


class FakeMcu(Faults):
    """The simulated board: `receive()` takes the host's bytes, `advance()` returns its own.

    Call `advance()` at the times that `next_ns()` returns.
    """

    def __init__(self, config: Config, now_ns: Ns = 0) -> None:
        super().__init__()
        self._vehicle = Vehicle(config.sim, config.drive)
        self.baud_rate = config.mcu.baud_rate
        self._counts = config.sim.encoder_counts
        self._wiring = _wiring(config.mcu.wheels)
        self._now_ns = self._moved_ns = now_ns  # last event or `advance()`; time of the vehicle
        self._events: list[tuple[int, int, str, bytes]] = []
        self._order = count()
        self._processing = cycle(PROCESSING_MS)
        self._held = self._batch = b""
        self._in_free_ns = self._out_free_ns = now_ns
        self._boot_until_ns = now_ns
        self._fed_ns = now_ns
        self._on_ns = now_ns
        self._angles: list[float] = []
        self._seen: list[int] = []  # counts of the motors a to d at `self._angles`
        self._window = (now_ns, self._encoders())
        self._measured = [0.0] * 4
        self._moved = [0] * 4
        self._counted = [0.0] * 4
        self._replied_ns = now_ns - NS_PER_S
        # Lines of the host with the time of their last byte, valid or not, obeyed or not.
        self.heard: deque[tuple[int, bytes]] = deque(maxlen=4096)
        self.valid_lines = 0
        self._watchdog_trips = 0
        self._checks = False  # the host has sent a valid checksum: status lines have one, too
        self._bumpers = "." * (len(config.safety.bumpers) or 4)  # while none is pressed
        # Begin, end, field of the status line, value. `silent` leaves the field out. The last fault
        # of a field decides, except that each pressed bumper is reported.
        self._inputs: tuple[tuple[int, int, str, str], ...] = ()
        self._inputs_clock = b""
        self._battery_clock = b""
        self._charge = self._capacity = 1.0  # 0 to 1, and ampere seconds
        # When the charge was computed, and when all set points were zero.
        self._drained_ns = self._rested_ns = now_ns
        self._lasting = ExitStack()
        for text in config.sim.faults:
            self._lasting.enter_context(self.switched_on(named(text)))

    @property
    def vehicle(self) -> Vehicle:
        """The simulated robot, moved to the time of the last call of `advance()`."""
        self._catch_up()
        return self._vehicle

    @property
    def watchdog_trips(self) -> int:
        """Number of times that the watchdog of the board has stopped the motors."""
        self._catch_up()
        return self._watchdog_trips

    # Time.

    def receive(self, now_ns: Ns, data: bytes) -> None:
        """Accept bytes that the host writes now; they reach the board at the speed of the wire."""
        start, offset = max(self._in_free_ns, now_ns), 0
        data = self._damaged(data)
        *lines, rest = data.split(b"\n")
        for piece in lines:
            offset += len(piece) + 1
            line = (self._held + piece + b"\n")[-256:]
            self._held = b""
            self._schedule(start + wire_ns(offset, self.baud_rate), "line", line)
        self._held = (self._held + rest)[-256:]
        self._in_free_ns = start + wire_ns(len(data), self.baud_rate)

    def next_ns(self) -> Ns | None:
        """Return when to call `advance()` next; None: not before `receive()`."""
        return self._events[0][0] if self._events else None

    def advance(self, now_ns: Ns) -> bytes:
        """Simulate the board until `now_ns`, and return what the host receives until then."""
        out = b""
        while self._events and self._events[0][0] <= now_ns:
            due_ns, _, what, data = heapq.heappop(self._events)
            self._now_ns = due_ns
            if what in ("sent", "batch"):
                out += self._handed_over(due_ns, what, data)
            elif what == "line":
                self.heard.append((due_ns, data))
                lost = self._hit("command", self.lose_command)
                if due_ns >= self._boot_until_ns and not lost:
                    delay = int(next(self._processing) * MS) + self.extra_delay_ns
                    self._schedule(due_ns + delay, "act", data)
            elif what == "act":
                self._act(due_ns, data)
            elif what == "booted":
                self._send_identity(due_ns)
            elif what == "report" and data == self._clock:
                if due_ns >= self._boot_until_ns:
                    self._reply(due_ns, protocol.Command({}))
                self._schedule(due_ns + self.unprompted_ns, "report", data)
            elif what == "status":
                self._send_inputs(due_ns)
            elif what == "inputs" and data == self._inputs_clock:
                self._send_inputs(due_ns)
                self._schedule(due_ns + STATUS_NS, "inputs", data)
            elif what == "battery" and data == self._battery_clock:
                self._send_battery(due_ns)
                self._schedule(due_ns + STATUS_NS, "battery", data)
        self._now_ns = now_ns
        return out

    def reset(self, now_ns: Ns, deaf_ns: Ns = RESET_NS) -> None:
        """Reset the board: it stops the motors, and ignores its input for `deaf_ns`.

        After half of this time it sends noise, as a bootloader does.
        """
        self._now_ns = now_ns
        self._events.clear()
        self._held = self._batch = b""
        self.vehicle.set_points[:] = [0.0] * 4
        self._boot_until_ns = now_ns + deaf_ns
        self._on_ns = now_ns + deaf_ns
        self._window = (now_ns, self._encoders())
        self._measured, self._counted = [0.0] * 4, [0.0] * 4
        self._schedule(now_ns + deaf_ns // 2, "sent", b"\x00\xf8\xff~boot\r\n")
        self._schedule(now_ns + deaf_ns, "booted", b"")
        self._checks = False
        if self._clock:
            self._schedule(now_ns + self.unprompted_ns, "report", self._clock)
        if self._inputs:
            self._schedule(now_ns + STATUS_NS, "inputs", self._inputs_clock)
        if self._battery_clock:
            self._schedule(now_ns + STATUS_NS, "battery", self._battery_clock)
        for begin_ns, end_ns, _, _ in self._inputs:
            self._schedule_changes(begin_ns, end_ns)

    def _schedule(self, due_ns: Ns, what: str, data: bytes) -> None:
        heapq.heappush(self._events, (due_ns, next(self._order), what, data))

    def _catch_up(self) -> None:
        vehicle, now_ns, moved_ns = self._vehicle, self._now_ns, self._moved_ns
        deadline = self._fed_ns + self.watchdog_ns
        if deadline <= now_ns and self.watchdog and any(vehicle.set_points):
            deadline = max(deadline, moved_ns)
            vehicle.advance((deadline - moved_ns) / NS_PER_S, self.push)
            moved_ns = deadline
            self._watchdog_trips += 1
            vehicle.set_points[:] = [0.0] * 4
        if now_ns > moved_ns:
            vehicle.advance((now_ns - moved_ns) / NS_PER_S, self.push)
            moved_ns = now_ns
        self._moved_ns = moved_ns

    # Lines.

    def _act(self, now_ns: Ns, line: bytes) -> None:
        if line.rstrip(b"\r\n") == b"?":
            self._send_identity(now_ns)
            return
        command = self.understand(line)
        if command is None:
            if self.any_feeds:
                self._catch_up()
                self._fed_ns = now_ns
            return
        # Reading the property `vehicle` first simulates the robot up to now with the old set
        # points.
        set_points = self.vehicle.set_points
        for output, value in command.values.items():
            motor = self.drivers[output]
            wheel, forward = self._wiring[motor]
            set_points[wheel] = forward * self.drives[motor] * value
        self.valid_lines += 1
        self._fed_ns = now_ns
        if not self.unprompted_ns:
            self._reply(now_ns, command)

    def _send_identity(self, now_ns: Ns) -> None:
        if self.understand is protocol.reference:
            self._send(
                now_ns, protocol.identity(self._counts, self.watchdog_ns // MS, self.samples)
            )

    def _reply(self, now_ns: Ns, command: protocol.Command) -> None:
        if self.muted or now_ns - self._replied_ns < self.reply_gap_ns:
            return
        self._replied_ns = now_ns
        comma, end = self.ending[:-2].encode(), self.ending[-2:].encode()
        speeds = tuple(self._speeds(now_ns))
        text = protocol.speeds_text(speeds, self.separator, self.unpadded_replies) + comma
        if command.sequence:
            self._checks = True
            sample = self._sample() if command.wants_sample and self.samples else ()
            text += protocol.suffix(text, command.sequence, sample)
        if self._hit("reply", self.lose_reply):
            return
        data = self._damaged(self.noise_bytes + text + end)
        self._send(now_ns, data[: len(data) // 2] if self.cut_replies else data)

    def _send(self, now_ns: Ns, data: bytes) -> None:
        begin_ns = max(self._out_free_ns, now_ns)
        end_ns = begin_ns + wire_ns(len(data), self.baud_rate)
        if begin_ns > now_ns and end_ns - now_ns > wire_ns(OUTPUT_BYTES, self.baud_rate):
            return
        self._out_free_ns = end_ns
        self._schedule(self._out_free_ns, "sent", data)

    def _handed_over(self, now_ns: Ns, what: str, data: bytes) -> bytes:
        # "batch": the adapter's timer has expired; "sent": `data` has come from the board.
        until_ns = self._stalled_until(now_ns)
        if until_ns > now_ns:
            self._schedule(until_ns, what, data)
            return b""
        begun, waited = bool(self._batch), self._batch + data
        full = len(waited) // USB_PACKET * USB_PACKET
        if what == "batch" or not self.latency_ns:
            full = len(waited)
        self._batch = waited[full:]
        if self._batch and not begun:
            tick_ns = -(-now_ns // self.latency_ns) * self.latency_ns
            self._schedule(tick_ns, "batch", b"")
        return waited[:full]

    def _encoders(self) -> list[int]:
        angles = self.vehicle.angles
        if angles != self._angles:
            floor, tau, per_turn = math.floor, math.tau, self._counts
            self._angles = angles.copy()
            self._seen = [floor(f * angles[w] / tau * per_turn + 0.5) for w, f in self._wiring]
        return self._seen

    def _speeds(self, now_ns: Ns) -> list[float]:
        since, before = self._window
        gains = self.gains
        if self.stuck is not None:
            gains = [0.0 if motor == self.stuck else gain for motor, gain in enumerate(gains)]
        if now_ns - since >= MIN_WINDOW_NS:
            counts = self._encoders()
            if counts == before and self.frozen is None:
                # No motor has turned by a count, so wrong gains and swapped wires have no effect.
                self._moved, self._measured = [0] * 4, [0.0] * 4
                self._window = (now_ns, counts)
                return [0.0] * 4
            scale = math.tau / self._counts * NS_PER_S / (now_ns - since)
            every = [b - a for a, b in zip(before, counts, strict=True)]
            signs = self.encoder_signs
            moved = [every[encoder] * signs[encoder] for encoder in self.encoders]
            if self.frozen is not None:
                moved[self.frozen] = self._moved[self.frozen]
            self._moved = moved
            measured = [count * scale for count in moved]
            if self.frozen is not None:
                measured[self.frozen] = self._measured[self.frozen]
            self._measured = measured
            rows = zip(self._counted, moved, gains, strict=True)
            self._counted = [total + count * gain for total, count, gain in rows]
            self._window = (now_ns, counts)
        speeds = [speed * gain for speed, gain in zip(self._measured, gains, strict=True)]
        return [speed if abs(speed) >= 0.005 else 0.0 for speed in speeds]

    def _sample(self) -> tuple[int, ...]:
        # ms since boot, and the four counts
        read_ns, _ = self._window
        return (read_ns - self._on_ns) // MS, *(round(count) for count in self._counted)

    def _send_inputs(self, now_ns: Ns) -> None:
        fields: dict[str, str] = {}
        for begin_ns, end_ns, name, value in self._inputs:
            before = fields.setdefault(name, self._bumpers if name == "bumpers" else "ok")
            if begin_ns <= now_ns < end_ns:
                both = name == "bumpers" and "silent" not in (value, before)
                fields[name] = "".join(map(max, value, before)) if both else value
        fields = {name: value for name, value in fields.items() if value != "silent"}
        if fields:
            self._send_status(now_ns, fields)

    def _send_status(self, now_ns: Ns, fields: dict[str, str]) -> None:
        if not self.muted and now_ns >= self._boot_until_ns:
            self._send(now_ns, self._damaged(protocol.status(fields, self._checks)))

    def _send_battery(self, now_ns: Ns) -> None:
        seconds, self._drained_ns = (now_ns - self._drained_ns) / NS_PER_S, now_ns
        turning = sum(map(abs, self.vehicle.set_points))
        if not turning:
            self._rested_ns = now_ns
        amps = REST_AMPS + AMPS_PER_SPEED * turning
        if turning and now_ns - self._rested_ns <= START_NS:
            amps += START_AMPS
        self._charge = max(0.0, self._charge - amps * seconds / self._capacity)
        volts = EMPTY_VOLTS + CHARGED_VOLTS * self._charge - RESISTANCE * amps
        charge = f"{100 * self._charge:.0f}%"
        fields = {"volts": f"{volts:.2f}", "amps": f"{-amps:.2f}", "charge": charge}
        self._send_status(now_ns, fields)

    def _schedule_changes(self, begin_ns: Ns, end_ns: Ns) -> None:
        for change_ns in (begin_ns, end_ns):
            if self._now_ns <= change_ns < NEVER_NS:
                self._schedule(change_ns, "status", b"")

    # The following faults are not in `faults.py`, because they need the events of the board.

    def estop(self) -> Fault:
        """Make the board report a released emergency stop ten times per second."""
        return self._input("estop", "ok")

    def estop_pressed(self, after_s: float, length_s: float) -> Fault:
        """Make the board report a press of the emergency stop; 0 s is a press without end.

        It reports a released one before and after. The motors keep their power.
        """
        return self._input("estop", "pressed", after_s, length_s)

    def estop_silent(self, after_s: float, length_s: float) -> Fault:
        """Make the board report a released emergency stop, with a pause; 0 s is one without end."""
        return self._input("estop", "silent", after_s, length_s)

    def bumpers(self) -> Fault:
        """Make the board report `safety.bumpers`, or four, all released."""
        return self._input("bumpers", self._bumpers)

    def bumper_pressed(self, number: float, after_s: float, length_s: float) -> Fault:
        """Make the board report a press of a bumper, counted from 1; 0 s is a press without end.

        It reports released ones before and after. The motors keep their power.
        """
        marks = ["X" if i == number else mark for i, mark in enumerate(self._bumpers, 1)]
        return self._input("bumpers", "".join(marks), after_s, length_s)

    def bumpers_silent(self, after_s: float, length_s: float) -> Fault:
        """Make the board report released bumpers, with a pause; 0 s is one without end."""
        return self._input("bumpers", "silent", after_s, length_s)

    def driver_fault(self, after_s: float, length_s: float) -> Fault:
        """Make the board report a fault of the motor driver; 0 s is one without end."""
        return self._input("driver", "fault", after_s, length_s)

    @contextmanager
    def battery(self, percent: float, minutes: float) -> Iterator[None]:
        """Make the board report a battery ten times per second. Its charge begins at `percent` %.

        A full one lasts `minutes` at rest, and less while the robot drives.
        """
        clock = b"battery %d" % next(self._order)
        self._schedule(self._now_ns + STATUS_NS, "battery", clock)
        with self._with(
            _battery_clock=clock,
            _charge=percent / 100,
            _capacity=REST_AMPS * 60 * minutes,
            _drained_ns=self._now_ns,
            _rested_ns=self._now_ns,
        ):
            yield

    @contextmanager
    def _input(
        self, field: str, value: str, after_s: float = 0.0, length_s: float = 0.0
    ) -> Iterator[None]:
        begin_ns = self._now_ns + int(after_s * NS_PER_S)
        end_ns = begin_ns + int(length_s * NS_PER_S) if length_s else NEVER_NS
        clock = self._inputs_clock
        if not clock:
            clock = b"inputs %d" % next(self._order)
            self._schedule(self._now_ns + STATUS_NS, "inputs", clock)
        self._schedule_changes(begin_ns, end_ns)
        inputs = (*self._inputs, (begin_ns, end_ns, field, value))
        with self._with(_inputs=inputs, _inputs_clock=clock):
            yield
        self._schedule(self._now_ns, "status", b"")

    @contextmanager
    def free_running(self, period_s: float = 0.1) -> Iterator[None]:
        """Make the board report every `period_s`, not in reply to each line.

        The reports end with a comma, and their speeds are not padded (`3.14` instead of `03.14`).
        """
        period_ns = int(period_s * NS_PER_S)
        # Each clock has a new name, so that the board ignores events of an older clock.
        clock = b"clock %d" % next(self._order)
        self._schedule(self._now_ns + period_ns, "report", clock)
        with self._with(
            unprompted_ns=period_ns, _clock=clock, unpadded_replies=True, ending=",\r\n"
        ):
            yield


def _wiring(wheels: WheelMap) -> list[tuple[int, int]]:
    # For the motors a to d: an index in `WHEELS`, and -1 if a positive speed turns it backward.
    motors = (wheels.front_right, wheels.front_left, wheels.rear_left, wheels.rear_right)
    place = {motor[1]: (index, -1 if motor[0] == "-" else 1) for index, motor in enumerate(motors)}
    return [place[letter] for letter in "abcd"]
