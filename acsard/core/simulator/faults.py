"""The switches for the faults of the simulated board and of its serial wire.

`fake_mcu.py` implements the effects of the faults. No fault is random: a fault that affects only
some of the lines affects every n-th line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from acsard.core.config.named_faults import NamedFault
from acsard.core.simulator import protocol
from acsard.core.values import NS_PER_S

Fault = AbstractContextManager[None]

USB_PACKET = 62
"""Size of a full USB packet, bytes. An FTDI adapter sends a full packet without waiting for its
timer."""

WATCHDOG_NS = 300_000_000
"""Time without a valid line from the host after which the board stops the motors, ns."""


class Faults:
    """The switches of all faults. A fault is on inside the `with` block of its method."""

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
        """True if invalid lines also reset the watchdog."""
        self.baud_rate = 115200
        self.reply_gap_ns = 0
        self.drivers = [0, 1, 2, 3]
        """The motor that each output drives. The outputs 0 to 3 are a to d of the board."""
        self.drives = [1.0] * 4
        """For each of the motors a to d, the factor from its command to its set point: 1, or -1 if
        the motor is reversed, or 0 if the motor is dead."""
        self.push: float | None = None
        """Speed at which a person pushes the robot, m/s, or None if nobody pushes it."""
        self.encoders = [0, 1, 2, 3]
        """The motor whose encoder is connected to each of the board's inputs a to d."""
        self.encoder_signs = [1, 1, 1, 1]
        """For the encoder of each of the motors a to d, the sign of its counts: 1, or -1 if the
        encoder is reversed."""
        self.understand: Callable[[bytes], protocol.Command | None] = protocol.reference
        self.samples = True
        self.latency_ns = 0
        """Interval of the USB adapter's timer, ns. When the timer expires, the adapter sends its
        packet even if the packet is not full. 0 means no adapter."""
        self.stall_every_ns = self.stall_ns = 0
        self.lose_reply = self.lose_command = self.bit_error = 0
        """Each of these three faults affects every n-th line. The value is n, or 0 if the fault is
        off."""
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
        # Until now the old switches were in force, so first simulate the vehicle with them.
        self._catch_up()
        for name, value in values.items():
            setattr(self, name, value)

    def _catch_up(self) -> None:
        """Simulate the vehicle up to now with the present switches, before a switch changes.

        `FakeMcu` implements this.
        """

    def _hit(self, what: str, every: int) -> bool:
        """Count an event. Return True for every n-th event, where n is `every`."""
        self._passed[what] += 1
        return every > 0 and self._passed[what] % every == 0

    def _damaged(self, data: bytes) -> bytes:
        if not data or not self._hit("bit", self.bit_error):
            return data
        place, bit = divmod(self._passed["bit"] * 59 % (8 * len(data)), 8)
        return b"%b%c%b" % (data[:place], data[place] ^ 1 << bit, data[place + 1 :])

    def switched_on(self, fault: NamedFault) -> Fault:
        """Return the context manager that switches on a fault from `[sim] faults` or `--fault`."""
        block: Fault = getattr(self, fault.name)(*fault.values)
        return block

    def mute(self) -> Fault:
        """Make the board obey lines but send no replies and no status lines.

        The board still identifies itself after a boot, and when the host asks it to.
        """
        return self._with(muted=True)

    def noise(self, data: bytes = b"\x00\xff~") -> Fault:
        """Make the board send the bytes `data` in front of each reply."""
        return self._with(noise_bytes=data)

    def partial_line(self) -> Fault:
        """Make the board send only the first half of each reply."""
        return self._with(cut_replies=True)

    def bias(self, wheel: int, gain: float) -> Fault:
        """Multiply the speed and counts that the board reports for motor `wheel` by `gain`.

        `wheel` is 0 to 3 for the motors a to d, even if encoders are swapped.
        """
        return self._with(gains=[gain if i == wheel else g for i, g in enumerate(self.gains)])

    def stuck_encoder(self, wheel: int) -> Fault:
        """Make the board report that motor `wheel` stands still, even while it turns.

        `wheel` is 0 to 3 for the motors a to d, even if encoders are swapped.
        """
        return self._with(stuck=wheel)

    def frozen_encoder(self, wheel: int) -> Fault:
        """Make the board repeat the last speed that it has reported for motor `wheel`.

        `wheel` is 0 to 3 for the motors a to d, even if encoders are swapped.
        """
        return self._with(frozen=wheel)

    @contextmanager
    def swapped_wheels(self, wheel: int, other: int) -> Iterator[None]:
        """Exchange two wheels, so that both their motors and their encoders are swapped.

        `wheel` and `other` are the numbers of the motors, 0 to 3 for a to d.
        """
        with self.swapped_motors(wheel, other), self.swapped_encoders(wheel, other):
            yield

    def swapped_motors(self, wheel: int, other: int) -> Fault:
        """Exchange the wires of the motors `wheel` and `other` (0 to 3 for a to d)."""
        return self._with(drivers=_swapped(self.drivers, wheel, other))

    def swapped_encoders(self, wheel: int, other: int) -> Fault:
        """Exchange the wires of the encoders `wheel` and `other` (0 to 3 for a to d)."""
        return self._with(encoders=_swapped(self.encoders, wheel, other))

    @contextmanager
    def reversed_wheel(self, wheel: int) -> Iterator[None]:
        """Reverse both the motor and the encoder `wheel` (0 to 3 for a to d)."""
        with self.reversed_motor(wheel), self.reversed_encoder(wheel):
            yield

    def reversed_motor(self, wheel: int) -> Fault:
        """Swap the two leads of motor `wheel` (0 to 3 for a to d), so that it turns backward."""
        return self._with(drives=[-d if i == wheel else d for i, d in enumerate(self.drives)])

    def reversed_encoder(self, wheel: int) -> Fault:
        """Swap the signals A and B of encoder `wheel` (0 to 3 for a to d), which reverses it."""
        signs = enumerate(self.encoder_signs)
        return self._with(encoder_signs=[-s if i == wheel else s for i, s in signs])

    def dead_motor(self, wheel: int) -> Fault:
        """Make the motor `wheel` (0 to 3 for a to d) ignore its commands."""
        return self._with(drives=[0.0 if i == wheel else d for i, d in enumerate(self.drives)])

    def pushed(self, speed: float) -> Fault:
        """Simulate a person who pushes the robot straight at `speed` m/s.

        The motors have no effect while the person pushes.
        """
        return self._with(push=speed)

    def slow_reply(self, delay_s: float = 0.03) -> Fault:
        """Make the board obey and answer each line with an additional delay of `delay_s` s."""
        return self._with(extra_delay_ns=int(delay_s * NS_PER_S))

    def sparse_replies(self, period_s: float = 0.1) -> Fault:
        """Make the board send at most one reply every `period_s` s."""
        return self._with(reply_gap_ns=int(period_s * NS_PER_S))

    def wrong_baud(self, baud_rate: int) -> Fault:
        """Make the board use `baud_rate` instead of the configured baud rate."""
        return self._with(baud_rate=baud_rate)

    def unpadded(self) -> Fault:
        """Make the board write speeds below ten with one integer digit, such as `3.14`."""
        return self._with(unpadded_replies=True)

    def spaces(self) -> Fault:
        """Make the board write a space after every comma."""
        return self._with(separator=", ")

    def trailing_comma(self) -> Fault:
        """Make the board end its replies with a comma."""
        return self._with(ending=",\r\n")

    def comma_latched(self) -> Fault:
        """Make the board obey each speed that is followed by a comma, and ignore checksums.

        Some old firmware behaves like this.
        """
        return self._with(understand=protocol.latched)

    def no_check(self) -> Fault:
        """Make the board ignore the checksums of the host's lines, and reply without checksums."""
        return self._with(understand=protocol.prefix)

    def plain_only(self) -> Fault:
        """Make the board obey only plain lines, and treat a line with a checksum as invalid."""
        return self._with(understand=protocol.plain_only)

    def no_sample(self) -> Fault:
        """Make the board reply with checksums, but never with its time and encoder counts."""
        return self._with(samples=False)

    def no_watchdog(self) -> Fault:
        """Make the board keep the motors running when the host sends no lines."""
        return self._with(watchdog=False)

    def late_watchdog(self, time_s: float = 1.0) -> Fault:
        """Make the board stop the motors only after `time_s` s without a valid line."""
        return self._with(watchdog_ns=int(time_s * NS_PER_S))

    def watchdog_fed_by_bad_lines(self) -> Fault:
        """Let invalid lines reset the watchdog, although the board does not obey them."""
        return self._with(any_feeds=True)

    def lost_replies(self, every: int = 5) -> Fault:
        """Lose one of every `every` replies on its way to the host."""
        return self._with(lose_reply=every)

    def lost_commands(self, every: int = 5) -> Fault:
        """Lose one of every `every` lines on its way to the board."""
        return self._with(lose_command=every)

    def bit_errors(self, every: int = 7) -> Fault:
        """Flip one bit in one of every `every` transmissions.

        A transmission is one line from the board, or all bytes of one write by the host.
        Transmissions in both directions are counted together. The position of the bit changes each
        time.
        """
        return self._with(bit_error=every)

    def ftdi(self, latency_s: float = 0.016) -> Fault:
        """Send replies through a USB adapter that delays them by up to `latency_s` s."""
        return self._with(latency_ns=int(latency_s * NS_PER_S))

    def stalls(self, every_s: float, length_s: float) -> Fault:
        """Hold back all bytes to the host for `length_s` s. A stall begins every `every_s` s."""
        return self._with(stall_every_ns=int(every_s * NS_PER_S), stall_ns=int(length_s * NS_PER_S))

    def _stalled_until(self, now_ns: int) -> int:
        if not self.stall_every_ns:
            return now_ns
        began_ns = now_ns // self.stall_every_ns * self.stall_every_ns
        return max(now_ns, began_ns + self.stall_ns)


def _swapped(order: list[int], first: int, other: int) -> list[int]:
    swapped = list(order)
    swapped[first], swapped[other] = order[other], order[first]
    return swapped
