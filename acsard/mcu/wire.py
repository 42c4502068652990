"""How long bytes take on the serial wire, and when the next line may go.

Pure arithmetic on nanoseconds. `LineGate` is the rule "we hold no line back to send it later"
(invariant 3) shared by the real port and by the tests' virtual one.
"""

from __future__ import annotations

from acsard.values import NS_PER_S

BITS_PER_BYTE = 10
"""8N1: start bit, eight data bits, stop bit."""

PLAIN_BYTES = 33
"""`ap12.50,bn08.75,cp15.00,dn10.25` and CR LF; one more with a trailing comma."""

CHECK_BYTES = 8
"""`#07*585F`: sequence and check, in both directions."""

SAMPLE_BYTES = 21
"""`@` and the five sample fields of a reply; the command that asks for them has one letter more."""

FIELD = 65536
"""The milliseconds and counts of the sample fields are modulo this: four hexadecimal digits."""

COMFORTABLE_USE = 0.8
"""Share of the wire above which a line that is a little late already meets the next one. It also
leaves room for replies with a space after each comma (36 bytes on their own wire, 9 % more)."""


def wire_ns(count: int, baud_rate: int) -> int:
    """Time `count` bytes occupy the wire, in ns."""
    return count * BITS_PER_BYTE * NS_PER_S // baud_rate


def line_bytes(trailing_comma: bool, check: bool = False, sample: bool = False) -> int:
    """Length of the longest line of either direction: each has a wire of its own.

    A plain reply is as long as its command; a sampled one is longer.
    """
    checked = PLAIN_BYTES + (CHECK_BYTES if check else 0)
    return max(checked + trailing_comma + sample, checked + (SAMPLE_BYTES if sample else 0))


def wire_use(rate_hz: float, baud_rate: int, count: int) -> float:
    """Share of the wire that `count` bytes per period take; above 1 they do not fit."""
    return count * BITS_PER_BYTE * rate_hz / baud_rate


def highest_rate(baud_rate: int, count: int, use: float = 1.0) -> int:
    """The most lines of `count` bytes per second that take no more than `use` of the wire."""
    return int(use * baud_rate / (count * BITS_PER_BYTE))


class LineGate:
    """Decides whether a line may be offered to the kernel now; it never keeps one."""

    def __init__(self, baud_rate: int) -> None:
        self._baud_rate = baud_rate
        self._free_ns = 0
        self._torn = True
        self.first = True
        """No whole line has gone yet: the next one must be zeros, whatever is wished by then."""

    def may_send(self, now_ns: int, kernel_bytes: int) -> bool:
        """True when the kernel holds nothing and the previous line has left the wire."""
        return kernel_bytes == 0 and now_ns >= self._free_ns

    @property
    def prefix(self) -> bytes:
        """What must precede the next line: an end of line after a torn line and after opening."""
        return b"\r\n" if self._torn else b""

    def note_sent(self, now_ns: int, offered: int, taken: int) -> None:
        """Record that the kernel took `taken` of `offered` bytes; the rest is dropped."""
        if taken:
            self._torn = taken < offered
        if taken == offered:
            self.first = False
        self._free_ns = now_ns + wire_ns(taken, self._baud_rate)
