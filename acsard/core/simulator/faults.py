"""The switches for the faults of the simulated board and of its serial wire (`fake_mcu.py`).

No fault is random: one that affects only some lines affects every n-th. Motors and encoders are
numbered 0 to 3 for a to d, an encoder by its motor even if encoders are swapped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from acsard.core.config.named_faults import NamedFault
from acsard.core.simulator import protocol
from acsard.core.values import NS_PER_S, Ns

Fault = AbstractContextManager[None]

USB_PACKET = 62  # bytes; an FTDI adapter sends a full packet without waiting for its timer

WATCHDOG_NS = 300_000_000  # without a valid line, the board stops the motors


class Faults:
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
        self.any_feeds = False  # invalid lines also reset the watchdog
        self.baud_rate = 115200
        self.reply_gap_ns = 0
        self.drivers = [0, 1, 2, 3]  # motor of each output a to d
        self.drives = [1.0] * 4  # of each motor, from command to set point: -1 reversed, 0 dead
        self.push: float | None = None  # m/s, by a person
        self.encoders = [0, 1, 2, 3]  # motor whose encoder is at each input a to d
        self.encoder_signs = [1, 1, 1, 1]  # -1: the motor's encoder is reversed
        self.understand: Callable[[bytes], protocol.Command | None] = protocol.reference
        self.samples = True
        self.latency_ns = 0  # of the USB adapter, which sends its packet then; 0: none
        self.stall_every_ns = self.stall_ns = 0
        self.lose_reply = self.lose_command = self.bit_error = 0  # every n-th line is hit; 0: off
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
        # Implemented by `FakeMcu`: simulate up to now, before a switch changes.
        ...

    def _hit(self, what: str, every: int) -> bool:
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

        It still identifies itself after a boot and on request.
        """
        return self._with(muted=True)

    def noise(self, data: bytes = b"\x00\xff~") -> Fault:
        """Make the board send `data` in front of each reply."""
        return self._with(noise_bytes=data)

    def partial_line(self) -> Fault:
        """Make the board send only the first half of each reply."""
        return self._with(cut_replies=True)

    def bias(self, wheel: int, gain: float) -> Fault:
        """Multiply the reported speed and counts of a motor by `gain`."""
        return self._with(gains=[gain if i == wheel else g for i, g in enumerate(self.gains)])

    def stuck_encoder(self, wheel: int) -> Fault:
        """Make the board report that a motor stands still, even while it turns."""
        return self._with(stuck=wheel)

    def frozen_encoder(self, wheel: int) -> Fault:
        """Make the board repeat the last reported speed of a motor."""
        return self._with(frozen=wheel)

    @contextmanager
    def swapped_wheels(self, wheel: int, other: int) -> Iterator[None]:
        """Swap two wheels, motors and encoders."""
        with self.swapped_motors(wheel, other), self.swapped_encoders(wheel, other):
            yield

    def swapped_motors(self, wheel: int, other: int) -> Fault:
        """Swap the wires of two motors."""
        return self._with(drivers=_swapped(self.drivers, wheel, other))

    def swapped_encoders(self, wheel: int, other: int) -> Fault:
        """Swap the wires of two encoders."""
        return self._with(encoders=_swapped(self.encoders, wheel, other))

    @contextmanager
    def reversed_wheel(self, wheel: int) -> Iterator[None]:
        """Reverse a motor and its encoder."""
        with self.reversed_motor(wheel), self.reversed_encoder(wheel):
            yield

    def reversed_motor(self, wheel: int) -> Fault:
        """Swap the two leads of a motor, so that it turns backward."""
        return self._with(drives=[-d if i == wheel else d for i, d in enumerate(self.drives)])

    def reversed_encoder(self, wheel: int) -> Fault:
        """Swap the signals A and B of an encoder, which reverses it."""
        signs = enumerate(self.encoder_signs)
        return self._with(encoder_signs=[-s if i == wheel else s for i, s in signs])

    def dead_motor(self, wheel: int) -> Fault:
        """Make a motor ignore its commands."""
        return self._with(drives=[0.0 if i == wheel else d for i, d in enumerate(self.drives)])

    def pushed(self, speed: float) -> Fault:
        """Simulate a person who pushes the robot straight at `speed` m/s, against the motors."""
        return self._with(push=speed)

    def slow_reply(self, delay_s: float = 0.03) -> Fault:
        """Make the board obey and answer each line later by `delay_s`."""
        return self._with(extra_delay_ns=int(delay_s * NS_PER_S))

    def sparse_replies(self, period_s: float = 0.1) -> Fault:
        """Make the board send at most one reply every `period_s`."""
        return self._with(reply_gap_ns=int(period_s * NS_PER_S))

    def wrong_baud(self, baud_rate: int) -> Fault:
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
        """Make the board obey each speed with a comma, and ignore checksums, as old firmware."""
        return self._with(understand=protocol.latched)

    def no_check(self) -> Fault:
        """Make the board ignore the checksums of the host's lines, and reply without checksums."""
        return self._with(understand=protocol.prefix)

    def plain_only(self) -> Fault:
        """Make the board obey only plain lines, and treat a line with a checksum as invalid."""
        return self._with(understand=protocol.plain_only)

    def no_sample(self) -> Fault:
        """Make the board reply with checksums, but without its time and encoder counts."""
        return self._with(samples=False)

    def no_watchdog(self) -> Fault:
        return self._with(watchdog=False)

    def late_watchdog(self, time_s: float = 1.0) -> Fault:
        """Make the board stop the motors only after `time_s` without a valid line."""
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
        """Flip one bit, always another one, in one of every `every` transmissions.

        A transmission is a line from the board or one write of the host, counted together.
        """
        return self._with(bit_error=every)

    def ftdi(self, latency_s: float = 0.016) -> Fault:
        """Send replies through a USB adapter that delays them by up to `latency_s`."""
        return self._with(latency_ns=int(latency_s * NS_PER_S))

    def stalls(self, every_s: float, length_s: float) -> Fault:
        """Hold back all bytes to the host for `length_s`, every `every_s`."""
        return self._with(stall_every_ns=int(every_s * NS_PER_S), stall_ns=int(length_s * NS_PER_S))

    def _stalled_until(self, now_ns: Ns) -> int:
        if not self.stall_every_ns:
            return now_ns
        began_ns = now_ns // self.stall_every_ns * self.stall_every_ns
        return max(now_ns, began_ns + self.stall_ns)


def _swapped(order: list[int], first: int, other: int) -> list[int]:
    swapped = list(order)
    swapped[first], swapped[other] = order[other], order[first]
    return swapped
