"""Computes how long lines take on the serial wire, and how many lines fit on it."""

from __future__ import annotations

from acsard.core.values import NS_PER_S

BITS_PER_BYTE = 10
"""Bits per byte with 8N1: a start bit, eight data bits and a stop bit."""

PLAIN_BYTES = 33
"""Length of the plain line `ap12.50,bn08.75,cp15.00,dn10.25` with CR LF, bytes. A trailing comma
adds one byte."""

CHECK_BYTES = 8
"""Length of the sequence number and the checksum of a command or a reply (`#07*585F`), bytes."""

SAMPLE_BYTES = 21
"""Length of `@` and the sample fields in a reply, bytes. The sample fields are the time of the
board and four encoder counts. In a command, the request for the sample fields takes one letter."""

STATUS_BYTES = 28
"""Length of `!status estop=pressed*F4BC`, a typical status line, with CR LF, bytes."""

STATUS_HZ = 10
"""Rate at which a board sends status lines, Hz."""

FIELD_VALUES = 65536
"""Number of different values of a sample field, which has four hexadecimal digits. After FFFF, the
field continues with 0."""

COMFORTABLE_USE = 0.8
"""Largest advisable use of the serial wire, as a fraction of its capacity. If the lines use more,
a line that is slightly late delays the next line. The remaining 20 % also suffice for a board that
writes a space after each comma, so that its lines have 36 bytes instead of 33."""


def wire_ns(count: int, baud_rate: int) -> int:
    """Return the time in ns that the serial wire needs to transmit `count` bytes."""
    return count * BITS_PER_BYTE * NS_PER_S // baud_rate


def line_bytes(trailing_comma: bool, check: bool = False, sample: bool = False) -> int:
    """Return the length of a command line or of its reply, whichever is longer, bytes.

    Each direction has its own wire, so only the longer line limits the rate.

    Args:
        trailing_comma: True if a comma follows the last wheel speed.
        check: True if lines have a sequence number and a checksum.
        sample: True if replies have sample fields, which a command requests by one more letter.
    """
    checked = PLAIN_BYTES + (CHECK_BYTES if check else 0)
    return max(checked + trailing_comma + sample, checked + (SAMPLE_BYTES if sample else 0))


def wire_use(rate_hz: float, baud_rate: int, count: int) -> float:
    """Return the fraction of the serial wire's capacity that lines of `count` bytes use.

    `rate_hz` is the number of lines per second. If the result is above 1, the lines do not fit.
    """
    return count * BITS_PER_BYTE * rate_hz / baud_rate


def highest_rate(baud_rate: int, count: int, use: float = 1.0) -> int:
    """Return the highest rate, Hz, at which lines of `count` bytes fit on the serial wire.

    The result is rounded down to an integer. `use` is the fraction of the wire's capacity that the
    lines may use, 0 to 1.
    """
    return int(use * baud_rate / (count * BITS_PER_BYTE))
