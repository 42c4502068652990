"""What fits on the serial wire: how long lines take at a baud rate, and how many fit.

Pure arithmetic on bytes, baud and ns, without knowledge of the settings or of the protocol's words.
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
