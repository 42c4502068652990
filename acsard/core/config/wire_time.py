"""Computes the time that lines take on the serial wire, and the number of lines that fit."""

from __future__ import annotations

from acsard.core.values import NS_PER_S

BITS_PER_BYTE = 10
"""Bits per byte with 8N1: a start bit, eight data bits and a stop bit."""

PLAIN_BYTES = 33
"""Length of `ap12.50,bn08.75,cp15.00,dn10.25` with CR LF, bytes. A trailing comma adds one."""

CHECK_BYTES = 8
"""Length of `#07*585F`, the sequence number and the checksum of a command or a reply, bytes."""

SAMPLE_BYTES = 21
"""Length of `@` and the five sample fields of a reply, bytes.

The fields are the board's clock and its four encoder counts. A command that requests them is one
letter longer.
"""

STATUS_BYTES = 28
"""Length of `!status estop=pressed*F4BC` with CR LF, bytes. With this line a board reports its
emergency stop. A status line with bumpers is about as long."""

STATUS_HZ = 10
"""Rate at which a board sends status lines, Hz."""

FIELD = 65536
"""Number of values that a sample field (an encoder count or the board's clock) can have.

The field has four hexadecimal digits, and FFFF wraps to 0.
"""

COMFORTABLE_USE = 0.8
"""Largest comfortable use of the wire, as a share of its capacity.

Above it, a line that is a little late delays the next one. The rest of the capacity also leaves
room for boards that send a space after each comma. Their replies have 36 instead of 33 bytes.
"""


def wire_ns(count: int, baud_rate: int) -> int:
    """Return the time that `count` bytes occupy the wire, in ns."""
    return count * BITS_PER_BYTE * NS_PER_S // baud_rate


def line_bytes(trailing_comma: bool, check: bool = False, sample: bool = False) -> int:
    """Return the length of a command or of its reply, whichever is longer, bytes.

    Each direction has its own wire, so only the longer line limits the rate.

    Args:
        trailing_comma: whether commands end with a comma.
        check: whether lines contain a sequence number and a checksum.
        sample: whether replies contain sample fields.
    """
    checked = PLAIN_BYTES + (CHECK_BYTES if check else 0)
    return max(checked + trailing_comma + sample, checked + (SAMPLE_BYTES if sample else 0))


def wire_use(rate_hz: float, baud_rate: int, count: int) -> float:
    """Return the share of the wire's capacity that lines of `count` bytes use at `rate_hz`.

    If the result is above 1, the wire is too slow for the lines.
    """
    return count * BITS_PER_BYTE * rate_hz / baud_rate


def highest_rate(baud_rate: int, count: int, use: float = 1.0) -> int:
    """Return the highest rate of lines, Hz, that uses at most the share `use` of the wire.

    `count` is the length of a line in bytes.
    """
    return int(use * baud_rate / (count * BITS_PER_BYTE))
