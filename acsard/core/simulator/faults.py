"""Faults of the simulated board and its wire, each a small named `with` block.

This module has the switches, and `fake_mcu.py` implements their effect. Nothing is random: a fault
hits every n-th line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from acsard.core.config.named_faults import NamedFault
from acsard.core.simulator import protocol
from acsard.core.values import NS_PER_S

Fault = AbstractContextManager[None]

USB_PACKET = 62
"""Bytes at which an FTDI adapter sends a packet without waiting for its timer."""

WATCHDOG_NS = 300_000_000
"""Silence after which the board stops the motors by itself."""


class Faults:
    """The switches of all faults. All are off, and a `with` block turns one on for its duration."""

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
        """Whether invalid lines feed the watchdog too."""
        self.baud_rate = 115200
        self.reply_gap_ns = 0
        self.drivers = [0, 1, 2, 3]
        """The motor that the output of each channel turns."""
        self.drives = [1.0] * 4
        """Factor from a channel's command to its motor: 1, -1 if reversed, 0 if dead."""
        self.push: float | None = None
        """Speed at which a person pushes the robot, m/s, None if nobody does."""
        self.encoders = [0, 1, 2, 3]
        """The motor whose encoder each channel reads."""
        self.encoder_signs = [1, 1, 1, 1]
        self.understand: Callable[[bytes], protocol.Command | None] = protocol.whole
        self.samples = True
        self.latency_ns = 0
        """Interval between two packets of the host's USB adapter, 0 for no adapter."""
        self.stall_every_ns = self.stall_ns = 0
        self.lose_reply = self.lose_command = self.bit_error = 0
        """The fault hits every n-th reply, command or line. 0 means never."""
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
        """Set these switches. Until now the vehicle has moved with the old values."""
        self._catch_up()
        for name, value in values.items():
            setattr(self, name, value)

    def _catch_up(self) -> None:
        """Move the vehicle up to now, in the subclass that has one."""

    def _hit(self, what: str, every: int) -> bool:
        """Count an event of this kind; return whether it is an n-th one."""
        self._passed[what] += 1
        return every > 0 and self._passed[what] % every == 0

    def _damaged(self, data: bytes) -> bytes:
        """Return the data after the wire, which may flip one bit."""
        if not data or not self._hit("bit", self.bit_error):
            return data
        place, bit = divmod(self._passed["bit"] * 59 % (8 * len(data)), 8)
        return b"%b%c%b" % (data[:place], data[place] ^ 1 << bit, data[place + 1 :])

    def having(self, fault: NamedFault) -> Fault:
        """Return the `with` block of a fault named in the configuration."""
        block: Fault = getattr(self, fault.name)(*fault.values)
        return block

    def mute(self) -> Fault:
        """Receive and drive, but answer nothing."""
        return self._with(muted=True)

    def noise(self, data: bytes = b"\x00\xff~") -> Fault:
        """Put garbage in front of every reply."""
        return self._with(noise_bytes=data)

    def partial_line(self) -> Fault:
        """Send only the first half of every reply."""
        return self._with(cut_replies=True)

    def bias(self, wheel: int, gain: float) -> Fault:
        """Report that motor `wheel` (0 to 3 for a to d) turns `gain` times as fast and as far."""
        return self._with(gains=[gain if i == wheel else g for i, g in enumerate(self.gains)])

    def stuck_encoder(self, wheel: int) -> Fault:
        """Report that motor `wheel` (0 to 3 for a to d) stands still although it may turn."""
        return self._with(stuck=wheel)

    def frozen_encoder(self, wheel: int) -> Fault:
        """Report that motor `wheel` (0 to 3 for a to d) keeps turning at its present speed."""
        return self._with(frozen=wheel)

    @contextmanager
    def swapped_wheels(self, wheel: int, other: int) -> Iterator[None]:
        """Connect two channels to each other's wheel, both motor and encoder."""
        with self.swapped_motors(wheel, other), self.swapped_encoders(wheel, other):
            yield

    def swapped_motors(self, wheel: int, other: int) -> Fault:
        """Connect two channels to each other's motor."""
        return self._with(drivers=_swapped(self.drivers, wheel, other))

    def swapped_encoders(self, wheel: int, other: int) -> Fault:
        """Connect two channels to each other's encoder."""
        return self._with(encoders=_swapped(self.encoders, wheel, other))

    @contextmanager
    def reversed_wheel(self, wheel: int) -> Iterator[None]:
        """Mount the wheel the other way round: its motor turns backward and its encoder agrees."""
        with self.reversed_motor(wheel), self.reversed_encoder(wheel):
            yield

    def reversed_motor(self, wheel: int) -> Fault:
        """Swap the two leads of a motor."""
        return self._with(drives=[-d if i == wheel else d for i, d in enumerate(self.drives)])

    def reversed_encoder(self, wheel: int) -> Fault:
        """Swap the A and B signals of an encoder."""
        signs = enumerate(self.encoder_signs)
        return self._with(encoder_signs=[-s if i == wheel else s for i, s in signs])

    def dead_motor(self, wheel: int) -> Fault:
        """Keep a motor from turning."""
        return self._with(drives=[0.0 if i == wheel else d for i, d in enumerate(self.drives)])

    def pushed(self, speed: float) -> Fault:
        """Push the robot straight ahead by hand at `speed` m/s, against its motors."""
        return self._with(push=speed)

    def slow_reply(self, delay_s: float = 0.03) -> Fault:
        """Take `delay_s` longer to act and answer."""
        return self._with(extra_delay_ns=int(delay_s * NS_PER_S))

    def sparse_replies(self, period_s: float = 0.1) -> Fault:
        """Answer only one line in `period_s`."""
        return self._with(reply_gap_ns=int(period_s * NS_PER_S))

    def wrong_baud(self, baud_rate: int) -> Fault:
        """Send and receive at another baud rate than the configured one."""
        return self._with(baud_rate=baud_rate)

    def unpadded(self) -> Fault:
        """Write speeds below ten with one integer digit."""
        return self._with(unpadded_replies=True)

    def spaces(self) -> Fault:
        """Write a space after every comma."""
        return self._with(separator=", ")

    def trailing_comma(self) -> Fault:
        """End the replies with a comma."""
        return self._with(ending=",\r\n")

    def comma_latched(self) -> Fault:
        """Obey a value only if a comma follows it, as the old sketches do.

        The check is ignored.
        """
        return self._with(understand=protocol.latched)

    def no_check(self) -> Fault:
        """Ignore everything after the fourth value: obey checked lines, answer plain ones."""
        return self._with(understand=protocol.prefix)

    def plain_only(self) -> Fault:
        """Obey plain lines only and treat a checked line as invalid."""
        return self._with(understand=protocol.plain_only)

    def no_sample(self) -> Fault:
        """Answer with the check, but never with the sample fields."""
        return self._with(samples=False)

    def no_watchdog(self) -> Fault:
        """Keep the motors running when the host falls silent."""
        return self._with(watchdog=False)

    def late_watchdog(self, time_s: float = 1.0) -> Fault:
        """Stop the motors only after `time_s` of silence."""
        return self._with(watchdog_ns=int(time_s * NS_PER_S))

    def watchdog_fed_by_bad_lines(self) -> Fault:
        """Keep the motors running for broken lines, which are not obeyed."""
        return self._with(any_feeds=True)

    def lost_replies(self, every: int = 5) -> Fault:
        """Lose every n-th reply on the way to the host."""
        return self._with(lose_reply=every)

    def lost_commands(self, every: int = 5) -> Fault:
        """Lose every n-th line on the way to the board."""
        return self._with(lose_command=every)

    def bit_errors(self, every: int = 7) -> Fault:
        """Flip one bit in every n-th line of either direction, another bit each time."""
        return self._with(bit_error=every)

    def ftdi(self, latency_s: float = 0.016) -> Fault:
        """Send through a USB adapter that passes data on at intervals, or when a packet is full.

        Bytes are late by up to `latency_s`, and several lines come at once.
        """
        return self._with(latency_ns=int(latency_s * NS_PER_S))

    def stalls(self, every_s: float, length_s: float) -> Fault:
        """Hold all bytes to the host for `length_s` s in every `every_s` s."""
        return self._with(stall_every_ns=int(every_s * NS_PER_S), stall_ns=int(length_s * NS_PER_S))

    def _stalled_until(self, now_ns: int) -> int:
        """Return when the present stall ends, or `now_ns` if none is under way."""
        if not self.stall_every_ns:
            return now_ns
        began_ns = now_ns // self.stall_every_ns * self.stall_every_ns
        return max(now_ns, began_ns + self.stall_ns)


def _swapped(order: list[int], one: int, other: int) -> list[int]:
    swapped = list(order)
    swapped[one], swapped[other] = order[other], order[one]
    return swapped
