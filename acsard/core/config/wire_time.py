"""Computes how long lines take on the serial wire at a baud rate, and how many fit.

The functions compute with bytes, baud and ns only. They know neither the settings nor the words of
the protocol.
"""

from __future__ import annotations

from acsard.core.values import NS_PER_S

BITS_PER_BYTE = 10
"""Bits per byte with 8N1: a start bit, eight data bits and a stop bit."""

PLAIN_BYTES = 33
"""Length of `ap12.50,bn08.75,cp15.00,dn10.25` with CR LF. A trailing comma adds one byte."""

CHECK_BYTES = 8
"""Length of `#07*585F`: sequence number and check, in both directions."""

SAMPLE_BYTES = 21
"""Length of `@` and the five sample fields of a reply. A command asks for them by one more
letter.
"""

FIELD = 65536
"""Modulus of the milliseconds and counts in the sample fields: four hexadecimal digits."""

COMFORTABLE_USE = 0.8
"""Share of the wire above which a line that is a little late already meets the next one. The
rest also leaves room for replies with a space after each comma (36 bytes on their own wire, 9 %
more).
"""


def wire_ns(count: int, baud_rate: int) -> int:
    """Return the time that `count` bytes occupy the wire, in ns."""
    return count * BITS_PER_BYTE * NS_PER_S // baud_rate


def line_bytes(trailing_comma: bool, check: bool = False, sample: bool = False) -> int:
    """Return the length of the longest line of either direction; each direction has its own wire.

    A plain reply is as long as its command; a sampled one is longer.
    """
    checked = PLAIN_BYTES + (CHECK_BYTES if check else 0)
    return max(checked + trailing_comma + sample, checked + (SAMPLE_BYTES if sample else 0))


def wire_use(rate_hz: float, baud_rate: int, count: int) -> float:
    """Return the share of the wire that `count` bytes per period take; above 1 they do not fit."""
    return count * BITS_PER_BYTE * rate_hz / baud_rate


def highest_rate(baud_rate: int, count: int, use: float = 1.0) -> int:
    """Return how many lines of `count` bytes per second use at most the share `use` of the wire."""
    return int(use * baud_rate / (count * BITS_PER_BYTE))
