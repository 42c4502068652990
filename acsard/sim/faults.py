"""What can be wrong with the fake MCU and its wire: each fault a small named `with` block.

Here are the switches; what they do is `fake_mcu.py`'s. Nothing is by chance: every n-th line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from acsard.config.named_faults import NamedFault
from acsard.sim import protocol
from acsard.values import NS_PER_S

Fault = AbstractContextManager[None]

USB_PACKET = 62
"""Bytes after which an FTDI adapter waits no longer."""

WATCHDOG_NS = 300_000_000
"""Silence after which the MCU stops the motors by itself."""


class Faults:
    """The switches, all off; a `with` block turns one on and back."""

    def __init__(self) -> None:
        self.muted = False
        self.noise_bytes = b""
        self.cut_replies = False
        self.gains = [1.0] * 4
        self.stuck: int | None = None
        self.frozen: int | None = None
        self.extra_delay_ns = 0
        self.separator = ","
        self.ending = "\r\n"
        self.unpadded_replies = False
        self.unprompted_ns = 0
        self.watchdog = True
        self.watchdog_ns = WATCHDOG_NS
        self.any_feeds = False
        """Lines that are none feed the watchdog too."""
        self.baud_rate = 115200
        self.reply_gap_ns = 0
        self.drivers = [0, 1, 2, 3]
        """Which motor each channel's output turns."""
        self.drives = [1.0] * 4
        """What of a channel's command reaches its motor: 1, turned round -1, none 0."""
        self.push: float | None = None
        """m/s at which hands move the robot."""
        self.encoders = [0, 1, 2, 3]
        """Which motor's encoder each channel reads."""
        self.encoder_signs = [1, 1, 1, 1]
        self.understand: Callable[[bytes], protocol.Command | None] = protocol.whole
        self.samples = True
        self.latency_ns = 0
        """Between two packets of the adapter at the host's end."""
        self.stall_every_ns = self.stall_ns = 0
        self.lose_reply = self.lose_command = self.bit_error = 0
        """Every how many-th is hit; 0 is none."""
        self._passed = {"reply": 0, "command": 0, "bit": 0}
        self._clock = b""

    @contextmanager
    def _with(self, **values: object) -> Iterator[None]:
        before = {name: getattr(self, name) for name in values}
        self._turn(values)
        try:
            yield
        finally:
            self._turn(before)

    def _turn(self, values: dict[str, object]) -> None:
        """Turn these switches; until now the vehicle has moved by what they were."""
        self._catch_up()
        for name, value in values.items():
            setattr(self, name, value)

    def _catch_up(self) -> None:
        """Move the vehicle up to now, where there is one."""

    def _hit(self, what: str, every: int) -> bool:
        """Count one more of `what`; whether it is the n-th."""
        self._passed[what] += 1
        return every > 0 and self._passed[what] % every == 0

    def _damaged(self, data: bytes) -> bytes:
        """The data after the wire: one bit of it may be turned."""
        if not data or not self._hit("bit", self.bit_error):
            return data
        place, bit = divmod(self._passed["bit"] * 59 % (8 * len(data)), 8)
        return b"%b%c%b" % (data[:place], data[place] ^ 1 << bit, data[place + 1 :])

    def having(self, fault: NamedFault) -> Fault:
        """The `with` block of the fault that a person named."""
        block: Fault = getattr(self, fault.name)(*fault.values)
        return block

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
        """Sees motor `wheel` (0 to 3 for a to d) turn `gain` times as fast and as far."""
        return self._with(gains=[gain if i == wheel else g for i, g in enumerate(self.gains)])

    def stuck_encoder(self, wheel: int) -> Fault:
        """Sees motor `wheel` (0 to 3 for a to d) stand whatever it does."""
        return self._with(stuck=wheel)

    def frozen_encoder(self, wheel: int) -> Fault:
        """Sees motor `wheel` (0 to 3 for a to d) turn on as fast as it did."""
        return self._with(frozen=wheel)

    @contextmanager
    def swapped_wheels(self, wheel: int, other: int) -> Iterator[None]:
        """Two channels are connected to each other's wheel, motor and encoder both."""
        with self.swapped_motors(wheel, other), self.swapped_encoders(wheel, other):
            yield

    def swapped_motors(self, wheel: int, other: int) -> Fault:
        """Two channels turn each other's motor."""
        return self._with(drivers=_swapped(self.drivers, wheel, other))

    def swapped_encoders(self, wheel: int, other: int) -> Fault:
        """Two channels read each other's encoder."""
        return self._with(encoders=_swapped(self.encoders, wheel, other))

    @contextmanager
    def reversed_wheel(self, wheel: int) -> Iterator[None]:
        """The wheel is mounted the other way round: its motor turns back and its encoder agrees."""
        with self.reversed_motor(wheel), self.reversed_encoder(wheel):
            yield

    def reversed_motor(self, wheel: int) -> Fault:
        """The motor's two leads are swapped."""
        return self._with(drives=[-d if i == wheel else d for i, d in enumerate(self.drives)])

    def reversed_encoder(self, wheel: int) -> Fault:
        """The encoder's A and B are swapped."""
        signs = enumerate(self.encoder_signs)
        return self._with(encoder_signs=[-s if i == wheel else s for i, s in signs])

    def dead_motor(self, wheel: int) -> Fault:
        """The motor does not turn."""
        return self._with(drives=[0.0 if i == wheel else d for i, d in enumerate(self.drives)])

    def pushed(self, speed: float) -> Fault:
        """Hands move the robot straight on at `speed` m/s, whatever its motors do."""
        return self._with(push=speed)

    def slow_reply(self, delay_s: float = 0.03) -> Fault:
        """Takes `delay_s` longer to act and answer."""
        return self._with(extra_delay_ns=int(delay_s * NS_PER_S))

    def sparse_replies(self, period_s: float = 0.1) -> Fault:
        """Answers only one line in so long."""
        return self._with(reply_gap_ns=int(period_s * NS_PER_S))

    def other_baud(self, baud_rate: int) -> Fault:
        """Speaks and listens at another rate than it was configured for."""
        return self._with(baud_rate=baud_rate)

    def unpadded(self) -> Fault:
        """Writes speeds below ten with one integer digit."""
        return self._with(unpadded_replies=True)

    def spaces(self) -> Fault:
        """Writes a space after every comma."""
        return self._with(separator=", ")

    def trailing_comma(self) -> Fault:
        """Ends its replies with a comma."""
        return self._with(ending=",\r\n")

    def comma_latched(self) -> Fault:
        """Takes a value only when a comma follows it, as the old sketches do; knows no check."""
        return self._with(understand=protocol.latched)

    def no_check(self) -> Fault:
        """Does not look beyond the fourth value: runs checked lines, answers plain."""
        return self._with(understand=protocol.prefix)

    def plain_only(self) -> Fault:
        """Takes plain lines only: a checked one is no line to it."""
        return self._with(understand=protocol.plain_only)

    def no_sample(self) -> Fault:
        """Answers with the check, but never with the sample fields."""
        return self._with(samples=False)

    def no_watchdog(self) -> Fault:
        """Keeps the motors running when the host falls silent."""
        return self._with(watchdog=False)

    def late_watchdog(self, time_s: float = 1.0) -> Fault:
        """Stops the motors only after so long a silence."""
        return self._with(watchdog_ns=int(time_s * NS_PER_S))

    def fed_by_anything(self) -> Fault:
        """Broken lines, which it does not obey, keep the motors running."""
        return self._with(any_feeds=True)

    def lost_replies(self, every: int = 5) -> Fault:
        """Every so many-th reply is lost on the way."""
        return self._with(lose_reply=every)

    def lost_commands(self, every: int = 5) -> Fault:
        """Every so many-th line is lost on its way to the MCU."""
        return self._with(lose_command=every)

    def bit_errors(self, every: int = 7) -> Fault:
        """In every so many-th line, of either direction, one bit is turned; another each time."""
        return self._with(bit_error=every)

    def ftdi(self, latency_s: float = 0.016) -> Fault:
        """Comes through a USB adapter that hands on what it has only so often, or when it is full:
        a line's bytes are late by up to that, and several lines come at once."""
        return self._with(latency_ns=int(latency_s * NS_PER_S))

    def stalls(self, every_s: float, length_s: float) -> Fault:
        """Every so often nothing reaches the host for a while; then all of it at once."""
        return self._with(stall_every_ns=int(every_s * NS_PER_S), stall_ns=int(length_s * NS_PER_S))

    def _stalled_until(self, now_ns: int) -> int:
        """When the host hears again; `now_ns` itself when it does now."""
        if not self.stall_every_ns:
            return now_ns
        began_ns = now_ns // self.stall_every_ns * self.stall_every_ns
        return max(now_ns, began_ns + self.stall_ns)


def _swapped(order: list[int], one: int, other: int) -> list[int]:
    swapped = list(order)
    swapped[one], swapped[other] = order[other], order[one]
    return swapped
