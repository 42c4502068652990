"""The microcontroller's side of the protocol, byte for byte and in time.

Bytes in, bytes out, the time given. It keeps the MCU contract by default: boots stopped, acts on
whole valid lines only, stops the motors when no valid line came for 300 ms. It shares no parser
with the host, so that an error in one does not hide in the other. Each fault is a `with` block:

    with mcu.mute(): ...
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import count, cycle

from acsard.mcu.wire import wire_ns
from acsard.settings import Config, WheelMap
from acsard.sim.vehicle import Vehicle
from acsard.values import NS_PER_S

Fault = AbstractContextManager[None]

MS = 1_000_000

WATCHDOG_NS = 300 * MS
"""Silence after which the MCU stops the motors by itself."""

RESET_NS = 2 * NS_PER_S
"""How long a board with a bootloader is deaf after a reset."""

SHORTEST_WINDOW_NS = 4 * MS
"""Encoder counts over less time than this say nothing; the last figures are sent again."""

PROCESSING_MS = (2.1, 1.3, 3.7, 1.0, 4.9, 2.6, 1.8, 3.2)
"""Time from the end of a line to the start of its answer, in turn: 1 to 5 ms, no randomness."""


class FakeMcu:
    """Feed it with `receive`, ask `next_ns` when it wants time, collect bytes with `advance`."""

    def __init__(self, config: Config, now_ns: int = 0) -> None:
        self.vehicle = Vehicle(config.sim, config.drive)
        self._baud_rate = config.mcu.baud_rate
        self._counts = config.sim.encoder_counts
        self._wiring = _wiring(config.mcu.wheels)
        self._now_ns = now_ns
        self._events: list[tuple[int, int, str, bytes]] = []
        self._order = count()
        self._processing = cycle(PROCESSING_MS)
        self._held = b""
        self._in_free_ns = self._out_free_ns = now_ns
        self._boot_until_ns = now_ns + int(config.sim.boot_time * NS_PER_S)
        self._fed_ns = now_ns
        self._window = (now_ns, self._encoders())
        self._measured = [0.0] * 4
        self.heard: deque[tuple[int, bytes]] = deque(maxlen=4096)
        """The last lines received with the time each was complete, valid or not, as they came."""
        self.valid_lines = 0
        self.watchdog_trips = 0
        self.muted = False
        self.noise_bytes = b""
        self.cut_replies = False
        self.gains = [1.0] * 4
        self.stuck: int | None = None
        self.extra_delay_ns = 0
        self.separator = ","
        self.ending = "\r\n"
        self.unpadded = False
        self.unprompted_ns = 0
        self._clock = b""
        self.latches_on_comma = False
        self.watchdog = True

    # time

    def receive(self, now_ns: int, data: bytes) -> None:
        """The host wrote `data`; it arrives at the pace of the wire."""
        start, taken = max(self._in_free_ns, now_ns), 0
        *lines, rest = data.split(b"\n")
        for piece in lines:
            taken += len(piece) + 1
            line = (self._held + piece + b"\n")[-256:]
            self._held = b""
            self._schedule(start + wire_ns(taken, self._baud_rate), "line", line)
        self._held = (self._held + rest)[-256:]
        self._in_free_ns = start + wire_ns(len(data), self._baud_rate)

    def next_ns(self) -> int | None:
        """When it next has something to do, or None."""
        return self._events[0][0] if self._events else None

    def advance(self, now_ns: int) -> bytes:
        """Let time pass up to `now_ns`; the bytes that have fully arrived at the host since."""
        out = b""
        while self._events and self._events[0][0] <= now_ns:
            due_ns, _, what, data = heapq.heappop(self._events)
            self._pass(due_ns)
            if what == "sent":
                out += data
            elif what == "line":
                self.heard.append((due_ns, data))
                if due_ns >= self._boot_until_ns:
                    delay = int(next(self._processing) * MS) + self.extra_delay_ns
                    self._schedule(due_ns + delay, "act", data)
            elif what == "act":
                self._act(due_ns, data)
            elif what == "report" and data == self._clock:
                if due_ns >= self._boot_until_ns:
                    self._reply(due_ns)
                self._schedule(due_ns + self.unprompted_ns, "report", data)
        self._pass(now_ns)
        return out

    def reset(self, now_ns: int) -> None:
        """Power on again: stopped, deaf while the bootloader runs, noise on the line first."""
        self._pass(now_ns)
        self._events.clear()
        self._held = b""
        self.vehicle.set_points[:] = [0.0] * 4
        self._boot_until_ns = now_ns + RESET_NS
        self._schedule(now_ns + RESET_NS // 2, "sent", b"\x00\xf8\xff~boot\r\n")
        if self._clock:
            self._schedule(now_ns + self.unprompted_ns, "report", self._clock)

    def _schedule(self, due_ns: int, what: str, data: bytes) -> None:
        heapq.heappush(self._events, (due_ns, next(self._order), what, data))

    def _pass(self, now_ns: int) -> None:
        """Move the vehicle; the watchdog trips at its own time on the way."""
        deadline = max(self._fed_ns + WATCHDOG_NS, self._now_ns)
        if self.watchdog and deadline <= now_ns and any(self.vehicle.set_points):
            self.vehicle.advance((deadline - self._now_ns) / NS_PER_S)
            self._now_ns = deadline
            self.watchdog_trips += 1
            self.vehicle.set_points[:] = [0.0] * 4
        if now_ns > self._now_ns:
            self.vehicle.advance((now_ns - self._now_ns) / NS_PER_S)
            self._now_ns = now_ns

    # lines

    def _act(self, now_ns: int, line: bytes) -> None:
        if self.latches_on_comma:
            self._latch_values(line)
        else:
            values = self._whole_line(line)
            if values is None:
                return
            for (wheel, forward), value in zip(self._wiring, values, strict=True):
                self.vehicle.set_points[wheel] = forward * value
        self.valid_lines += 1
        self._fed_ns = now_ns
        if not self.unprompted_ns:
            self._reply(now_ns)

    @staticmethod
    def _whole_line(line: bytes) -> list[float] | None:
        tokens = line.strip().removesuffix(b",").split(b",")
        if [token[:1] for token in tokens] != [b"a", b"b", b"c", b"d"]:
            return None
        values = []
        for token in tokens:
            whole, point, part = token[2:].partition(b".")
            if token[1:2] not in (b"p", b"n") or point != b".":
                return None
            if len(whole) != 2 or len(part) != 2 or not (whole + part).isdigit():
                return None
            values.append((int(whole) + int(part) / 100) * (1 if token[1:2] == b"p" else -1))
        return values

    def _latch_values(self, line: bytes) -> None:
        """The old sketches: a value counts when a comma ends it, whatever the rest says."""
        for token in line.split(b",")[:-1]:
            motor, sign = token[:1], token[1:2]
            if motor in (b"a", b"b", b"c", b"d") and sign in (b"p", b"n"):
                try:
                    value = float(token[2:])
                except ValueError:
                    continue
                if math.isfinite(value):
                    wheel, forward = self._wiring[b"abcd".index(motor)]
                    self.vehicle.set_points[wheel] = forward * (value if sign == b"p" else -value)

    def _reply(self, now_ns: int) -> None:
        if self.muted:
            return
        text = self.separator.join(
            f"{motor}{'n' if speed < 0 else 'p'}{self._figure(abs(speed))}"
            for motor, speed in zip("abcd", self._speeds(now_ns), strict=True)
        )
        data = self.noise_bytes + (text + self.ending).encode()
        if self.cut_replies:
            data = data[: len(data) // 2]
        self._out_free_ns = max(self._out_free_ns, now_ns) + wire_ns(len(data), self._baud_rate)
        self._schedule(self._out_free_ns, "sent", data)

    def _figure(self, value: float) -> str:
        return f"{min(value, 99.99):.2f}" if self.unpadded else f"{min(value, 99.99):05.2f}"

    def _encoders(self) -> list[int]:
        """Counts of motors a to d."""
        angles = self.vehicle.angles
        return [math.floor(f * angles[w] / math.tau * self._counts + 0.5) for w, f in self._wiring]

    def _speeds(self, now_ns: int) -> list[float]:
        """What the encoders say: whole counts over the time since they were last read."""
        since, before = self._window
        if now_ns - since >= SHORTEST_WINDOW_NS:
            counts = self._encoders()
            scale = math.tau / self._counts * NS_PER_S / (now_ns - since)
            self._measured = [(b - a) * scale for a, b in zip(before, counts, strict=True)]
            self._window = (now_ns, counts)
        seen = [speed * gain for speed, gain in zip(self._measured, self.gains, strict=True)]
        if self.stuck is not None:
            seen[self.stuck] = 0.0
        return [speed if abs(speed) >= 0.005 else 0.0 for speed in seen]

    # faults

    @contextmanager
    def _with(self, **values: object) -> Iterator[None]:
        before = {name: getattr(self, name) for name in values}
        for name, value in values.items():
            setattr(self, name, value)
        try:
            yield
        finally:
            for name, value in before.items():
                setattr(self, name, value)

    def mute(self) -> Fault:
        """Hears and drives, but answers nothing."""
        return self._with(muted=True)

    def noise(self, data: bytes = b"\x00\xff~") -> Fault:
        """Puts garbage in front of every reply."""
        return self._with(noise_bytes=data)

    def partial_line(self) -> Fault:
        """Sends only the first half of every reply."""
        return self._with(cut_replies=True)

    def bias(self, wheel: int, gain: float) -> Fault:
        """Reports the speed of motor `wheel` (0 to 3 for a to d) times `gain`."""
        return self._with(gains=[gain if i == wheel else g for i, g in enumerate(self.gains)])

    def stuck_encoder(self, wheel: int) -> Fault:
        """Reports zero for motor `wheel` (0 to 3 for a to d) whatever it does."""
        return self._with(stuck=wheel)

    def slow_reply(self, delay_s: float = 0.03) -> Fault:
        """Takes `delay_s` longer to act and answer."""
        return self._with(extra_delay_ns=int(delay_s * NS_PER_S))

    def spaces(self) -> Fault:
        """Writes a space after every comma."""
        return self._with(separator=", ")

    def trailing_comma(self) -> Fault:
        """Ends its replies with a comma."""
        return self._with(ending=",\r\n")

    def comma_latched(self) -> Fault:
        """Takes a value only when a comma follows it, as the old sketches do."""
        return self._with(latches_on_comma=True)

    def no_watchdog(self) -> Fault:
        """Keeps the motors running when the host falls silent."""
        return self._with(watchdog=False)

    @contextmanager
    def unprompted(self, period_s: float = 0.1) -> Iterator[None]:
        """Reports by its own clock instead of answering: unpadded, with a trailing comma."""
        period_ns = int(period_s * NS_PER_S)
        clock = b"clock %d" % next(self._order)  # a new one: an older one's events go unheeded
        self._schedule(self._now_ns + period_ns, "report", clock)
        with self._with(unprompted_ns=period_ns, _clock=clock, unpadded=True, ending=",\r\n"):
            yield


def _wiring(wheels: WheelMap) -> list[tuple[int, int]]:
    """For motors a to d the wheel (`values.WHEELS` order) and 1 or -1: as the host believes."""
    motors = (wheels.front_right, wheels.front_left, wheels.rear_left, wheels.rear_right)
    place = {motor[1]: (index, -1 if motor[0] == "-" else 1) for index, motor in enumerate(motors)}
    return [place[letter] for letter in "abcd"]


FAULTS = (
    "mute", "noise", "partial_line", "slow_reply", "spaces", "trailing_comma", "comma_latched",
    "no_watchdog", "unprompted",
)  # fmt: skip
"""The faults that need no argument, by method name: what `acsard sim --fault` offers."""
