"""Simulates the board: its side of the serial protocol, with the time of each byte on the wire.

It does not use the daemon's parser, so an error there makes tests fail. A test switches a fault on
for a `with` block, such as `with mcu.fault("mute"):`. Those of `[sim] faults` are always on. The
table of the faults is `core/config/simulated_faults.py`.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import count, cycle

from msgspec.structs import replace

from acsard.core.config.settings import Config, WheelMap
from acsard.core.config.simulated_faults import (
    FAULTS,
    NEVER_NS,
    BoardBattery,
    BoardClock,
    Switches,
    parse,
)
from acsard.core.config.wire_time import wire_ns
from acsard.core.simulator import protocol
from acsard.core.simulator.vehicle import Vehicle, whole_counts
from acsard.core.values import NS_PER_S, Ns

MS = 1_000_000

RESET_NS = 2 * NS_PER_S  # a board with a bootloader ignores its input after a reset

# A reply within this time after the last computation from encoder counts repeats its speeds.
MIN_WINDOW_NS = 4 * MS

OUTPUT_BYTES = 255  # bytes; a line that does not fit is dropped, as by `deploy/firmware`

USB_PACKET = 62  # bytes; an FTDI adapter sends a full packet without waiting for its timer

# Six cells: V of the empty battery, additional V of a full one, ohm.
EMPTY_VOLTS, CHARGED_VOLTS, RESISTANCE = 21.0, 4.2, 0.2

# The events that the board schedules again and again, in the order of those of one time.
CLOCKS = ("report", "inputs", "battery", "reset")

REST_AMPS, AMPS_PER_SPEED = 0.5, 0.05  # A at rest, and A for each rad/s of each wheel

START_AMPS, START_NS = 10.0, 300 * MS  # while the motors start; it lowers the voltage by 2 V

# From the arrival of a line to the start of the reply, in turn.
PROCESSING_MS = (2.1, 1.3, 3.7, 1.0, 4.9, 2.6, 1.8, 3.2)


class FakeMcu:
    """The simulated board: `receive()` takes the host's bytes, `advance()` returns its own.

    Call `advance()` at the times that `next_ns()` returns.
    """

    def __init__(self, config: Config, now_ns: Ns = 0) -> None:
        self._vehicle = Vehicle(config.sim, config.drive)
        self.letters = config.mcu.wheels.letters
        motors = self._motors = len(self.letters)
        self.switches = Switches(
            config.mcu.baud_rate,
            bumpers="." * (len(config.safety.bumpers) or 4),
            gains=(1.0,) * motors,
            drivers=tuple(range(motors)),
            drives=(1.0,) * motors,
            encoders=tuple(range(motors)),
            encoder_signs=(1,) * motors,
        )
        self._passed = {"reply": 0, "command": 0, "bit": 0}  # for faults of every n-th
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
        self._seen: list[int] = []  # counts of the motors at `self._angles`
        self._window = (now_ns, self._encoders())
        self._measured = [0.0] * motors
        self._moved = [0] * motors
        self._counted = [0.0] * motors
        self._edges, self._edge_signs = [0] * motors, [1] * motors  # since the last report
        self._signs, self._pins = [1] * motors, [1] * motors  # of directions: noted, in force
        self._replied_ns = now_ns - NS_PER_S
        # Lines of the host with the time of their last byte, valid or not, obeyed or not.
        self.heard: deque[tuple[int, bytes]] = deque(maxlen=4096)
        self.valid_lines = 0
        self._watchdog_trips = 0
        self._checks = False  # the host has sent a valid checksum: status lines have one, too
        self._lasting = ExitStack()
        for text in config.sim.faults:
            self._lasting.enter_context(self.fault(*parse(text, self.letters)))

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
            self._schedule(start + wire_ns(offset, self.switches.baud_rate), "line", line)
        self._held = (self._held + rest)[-256:]
        self._in_free_ns = start + wire_ns(len(data), self.switches.baud_rate)

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
                lost = self._hit("command", self.switches.lose_command)
                if due_ns >= self._boot_until_ns and not lost:
                    delay = int(next(self._processing) * MS) + self.switches.extra_delay_ns
                    self._schedule(due_ns + delay, "act", data)
            elif what == "act":
                self._act(due_ns, data)
            elif what == "booted":
                self._send_identity(due_ns)
            elif what == "status":
                self._send_inputs(due_ns)
            elif (clock := self.switches.clocks.get(what)) and clock.name == data:
                self._tick(due_ns, what, clock)
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
        self._measured, self._counted = [0.0] * self._motors, [0.0] * self._motors
        self._schedule(now_ns + deaf_ns // 2, "sent", b"\x00\xf8\xff~boot\r\n")
        self._schedule(now_ns + deaf_ns, "booted", b"")
        self._checks = False
        for what in CLOCKS:
            if clock := self.switches.clocks.get(what):
                self._schedule_tick(now_ns, what, clock)
        for begin_ns, end_ns, _, _ in self.switches.inputs:
            self._schedule_changes(begin_ns, end_ns)

    def _tick(self, now_ns: Ns, what: str, clock: BoardClock) -> None:
        if what == "reset":
            self.reset(now_ns)
            return
        if what == "report" and now_ns >= self._boot_until_ns:
            self._reply(now_ns, protocol.BoardCommand({}))
        elif what == "inputs":
            self._send_inputs(now_ns)
        elif what == "battery" and self.switches.battery:
            self._send_battery(now_ns, self.switches.battery)
        self._schedule_tick(now_ns, what, clock)

    def _schedule_tick(self, now_ns: Ns, what: str, clock: BoardClock) -> None:
        self._schedule(now_ns + clock.period_ns, what, clock.name)

    def _schedule(self, due_ns: Ns, what: str, data: bytes) -> None:
        heapq.heappush(self._events, (due_ns, next(self._order), what, data))

    def _catch_up(self) -> None:
        vehicle, now_ns, moved_ns = self._vehicle, self._now_ns, self._moved_ns
        deadline = self._fed_ns + self.switches.watchdog_ns
        if deadline <= now_ns and self.switches.watchdog and any(vehicle.set_points):
            deadline = max(deadline, moved_ns)
            vehicle.advance((deadline - moved_ns) / NS_PER_S, self.switches.push)
            moved_ns = deadline
            self._watchdog_trips += 1
            vehicle.set_points[:] = [0.0] * 4
        if now_ns > moved_ns:
            vehicle.advance((now_ns - moved_ns) / NS_PER_S, self.switches.push)
            moved_ns = now_ns
        self._moved_ns = moved_ns
        if self.switches.last_edge:
            before = self._seen
            for motor, (old, new) in enumerate(zip(before, self._count(), strict=True)):
                self._edges[motor] += abs(new - old)
                self._edge_signs[motor] = (new > old) - (new < old) or self._edge_signs[motor]

    # Lines.

    def _act(self, now_ns: Ns, line: bytes) -> None:
        if line.rstrip(b"\r\n") == b"?":
            self._send_identity(now_ns)
            return
        if self.switches.toggled:
            self._toggle(line)
        command = self.understand(line)
        if command is None:
            if self.switches.any_feeds:
                self._catch_up()
                self._fed_ns = now_ns
            return
        # Reading the property `vehicle` first simulates the robot up to now with the old set
        # points.
        set_points = self.vehicle.set_points
        for output, value in command.values.items():
            motor = self.switches.drivers[output]
            wheels, forward = self._wiring[motor]
            if abs(value) < self.switches.dead_band:
                value = 0.0
            if self.switches.toggled:
                value = abs(value) * self._pins[output]
            for wheel in wheels:
                set_points[wheel] = forward * self.switches.drives[motor] * value
        self.valid_lines += 1
        self._fed_ns = now_ns
        if "report" not in self.switches.clocks:
            self._reply(now_ns, command)

    def understand(self, line: bytes) -> protocol.BoardCommand | None:
        """Decode a line of the host as the firmware does."""
        return protocol.DECODERS[self.switches.firmware](line, self.letters)

    def _toggle(self, line: bytes) -> None:
        tokens = line.split(b",")
        for place, token in enumerate(tokens):
            motor = self.letters.encode().find(token[:1] or b"?")
            sign = {b"p": 1, b"n": -1}.get(token[1:2])
            if motor < 0 or not sign:
                continue
            if sign != self._signs[motor]:
                self._pins[motor] *= -1
            if place < len(tokens) - 1:
                self._signs[motor] = sign

    def _send_identity(self, now_ns: Ns) -> None:
        switches = self.switches
        if switches.firmware == "reference" and not switches.muted:
            self._send(
                now_ns,
                protocol.identity(self._counts, switches.watchdog_ns // MS, switches.samples),
            )

    def _reply(self, now_ns: Ns, command: protocol.BoardCommand) -> None:
        switches = self.switches
        if switches.muted or now_ns - self._replied_ns < switches.reply_gap_ns:
            return
        self._replied_ns = now_ns
        comma, end = switches.ending[:-2].encode(), switches.ending[-2:].encode()
        speeds = tuple(self._speeds(now_ns))
        text = protocol.speeds_text(
            self.letters, speeds, switches.separator, switches.unpadded_replies
        )
        text += comma
        if command.sequence:
            self._checks = True
            sample = self._sample() if command.wants_sample and switches.samples else ()
            text += protocol.suffix(text, command.sequence, sample)
        if self._hit("reply", switches.lose_reply):
            return
        data = self._damaged(switches.noise_bytes + text + end)
        self._send(now_ns, data[: len(data) // 2] if switches.cut_replies else data)

    def _send(self, now_ns: Ns, data: bytes) -> None:
        begin_ns = max(self._out_free_ns, now_ns)
        end_ns = begin_ns + wire_ns(len(data), self.switches.baud_rate)
        if begin_ns > now_ns and end_ns - now_ns > wire_ns(OUTPUT_BYTES, self.switches.baud_rate):
            return
        self._out_free_ns = end_ns
        self._schedule(self._out_free_ns, "sent", data)

    def _handed_over(self, now_ns: Ns, what: str, data: bytes) -> bytes:
        # "batch": the adapter's timer has expired; "sent": `data` has come from the board.
        switches = self.switches
        until_ns = self._stalled_until(now_ns)
        if until_ns > now_ns:
            self._schedule(until_ns, what, data)
            return b""
        begun, waited = bool(self._batch), self._batch + data
        full = len(waited) // USB_PACKET * USB_PACKET
        if what == "batch" or not switches.latency_ns:
            full = len(waited)
        self._batch = waited[full:]
        if self._batch and not begun:
            tick_ns = -(-now_ns // switches.latency_ns) * switches.latency_ns
            self._schedule(tick_ns, "batch", b"")
        return waited[:full]

    def _encoders(self) -> list[int]:
        self._catch_up()
        return self._count()

    def _count(self) -> list[int]:
        angles = self._vehicle.angles
        if angles != self._angles:
            self._angles = angles.copy()
            self._seen = [whole_counts(f * angles[w[0]], self._counts) for w, f in self._wiring]
        return self._seen

    def _speeds(self, now_ns: Ns) -> list[float]:
        since, before = self._window
        switches, gains = self.switches, self.switches.gains
        if switches.stuck is not None:
            gains = (*gains[: switches.stuck], 0.0, *gains[switches.stuck + 1 :])
        if now_ns - since >= MIN_WINDOW_NS:
            counts = self._encoders()
            if counts == before and switches.frozen is None:
                # No motor has turned by a count, so wrong gains and swapped wires have no effect.
                self._moved, self._measured = [0] * self._motors, [0.0] * self._motors
                self._window = (now_ns, counts)
                return [0.0] * self._motors
            scale = math.tau / self._counts * NS_PER_S / (now_ns - since)
            every = [b - a for a, b in zip(before, counts, strict=True)]
            if switches.last_edge:
                pairs = zip(self._edges, self._edge_signs, strict=True)
                every, self._edges = [edges * sign for edges, sign in pairs], [0] * self._motors
            signs = switches.encoder_signs
            moved = [every[encoder] * signs[encoder] for encoder in switches.encoders]
            if switches.frozen is not None:
                moved[switches.frozen] = self._moved[switches.frozen]
            self._moved = moved
            measured = [count * scale for count in moved]
            if switches.frozen is not None:
                measured[switches.frozen] = self._measured[switches.frozen]
            self._measured = measured
            rows = zip(self._counted, moved, gains, strict=True)
            self._counted = [total + count * gain for total, count, gain in rows]
            self._window = (now_ns, counts)
        speeds = [speed * gain for speed, gain in zip(self._measured, gains, strict=True)]
        return [speed if abs(speed) >= 0.005 else 0.0 for speed in speeds]

    def _sample(self) -> tuple[int, ...]:
        # ms since boot, and the counts
        read_ns, _ = self._window
        return (read_ns - self._on_ns) // MS, *(round(count) for count in self._counted)

    def _send_inputs(self, now_ns: Ns) -> None:
        fields: dict[str, str] = {}
        for begin_ns, end_ns, name, value in self.switches.inputs:
            before = fields.setdefault(name, self.switches.bumpers if name == "bumpers" else "ok")
            if begin_ns <= now_ns < end_ns:
                both = name == "bumpers" and "silent" not in (value, before)
                fields[name] = "".join(map(max, value, before)) if both else value
        fields = {name: value for name, value in fields.items() if value != "silent"}
        if fields:
            self._send_status(now_ns, fields)

    def _send_status(self, now_ns: Ns, fields: dict[str, str]) -> None:
        if not self.switches.muted and now_ns >= self._boot_until_ns:
            self._send(now_ns, self._damaged(protocol.status(fields, self._checks)))

    def _send_battery(self, now_ns: Ns, battery: BoardBattery) -> None:
        seconds, battery.drained_ns = (now_ns - battery.drained_ns) / NS_PER_S, now_ns
        turning = sum(map(abs, self.vehicle.set_points))
        if not turning:
            battery.rested_ns = now_ns
        amps = REST_AMPS + AMPS_PER_SPEED * turning
        if turning and now_ns - battery.rested_ns <= START_NS:
            amps += START_AMPS
        capacity = REST_AMPS * 60 * battery.minutes
        battery.charge = max(0.0, battery.charge - amps * seconds / capacity)
        volts = EMPTY_VOLTS + CHARGED_VOLTS * battery.charge - RESISTANCE * amps
        charge = f"{100 * battery.charge:.0f}%"
        fields = {"volts": f"{volts:.2f}", "amps": f"{-amps:.2f}", "charge": charge}
        self._send_status(now_ns, fields)

    def _schedule_changes(self, begin_ns: Ns, end_ns: Ns) -> None:
        for change_ns in (begin_ns, end_ns):
            if self._now_ns <= change_ns < NEVER_NS:
                self._schedule(change_ns, "status", b"")

    # Faults.

    def fault(self, name: str, *arguments: object) -> AbstractContextManager[None]:
        """Switch on a fault of the table for a `with` block."""
        return self.switched(FAULTS[name].switch, *arguments)

    @contextmanager
    def switched(self, change: Callable[..., Switches], *arguments: object) -> Iterator[None]:
        """Change the switches for a `with` block, as the function of a row of the table does."""
        before = self.switches
        self._turn(change(replace(before, now_ns=self._now_ns), *arguments))
        try:
            yield
        finally:
            self._turn(before)

    def _turn(self, switches: Switches) -> None:
        # Until now the old switches were in force, so first simulate the vehicle with them.
        self._catch_up()
        before, self.switches = self.switches, switches
        for what, clock in switches.clocks.items():
            if clock is not before.clocks.get(what):
                clock.name = b"%d" % next(self._order)
                self._schedule_tick(self._now_ns, what, clock)
        for begin_ns, end_ns, _, _ in switches.inputs[len(before.inputs) :]:
            self._schedule_changes(begin_ns, end_ns)
        if len(switches.inputs) < len(before.inputs):
            self._schedule(self._now_ns, "status", b"")

    def _hit(self, what: str, every: int) -> bool:
        self._passed[what] += 1
        return every > 0 and self._passed[what] % every == 0

    def _damaged(self, data: bytes) -> bytes:
        if not data or not self._hit("bit", self.switches.bit_error):
            return data
        place, bit = divmod(self._passed["bit"] * 59 % (8 * len(data)), 8)
        return b"%b%c%b" % (data[:place], data[place] ^ 1 << bit, data[place + 1 :])

    def _stalled_until(self, now_ns: Ns) -> Ns:
        every_ns = self.switches.stall_every_ns
        if not every_ns:
            return now_ns
        return max(now_ns, now_ns // every_ns * every_ns + self.switches.stall_ns)


def _wiring(wheels: WheelMap) -> list[tuple[tuple[int, ...], int]]:
    # For each motor: its wheel as an index in `WHEELS`, or those of its side if there are two
    # motors, and -1 if a positive speed turns it backward.
    place = {
        motor[1]: ((n,) if len(wheels.motors) == 4 else (n, 3 - n), -1 if motor[0] == "-" else 1)
        for n, motor in enumerate(wheels.motors)
    }
    return [place[letter] for letter in wheels.letters]
