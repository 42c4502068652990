"""Computes the time that lines take on the serial wire, and the number of lines that fit."""

from __future__ import annotations

from acsard.core.values import NS_PER_S

BITS_PER_BYTE = 10
"""Bits per byte with 8N1: a start bit, eight data bits and a stop bit."""

PLAIN_BYTES = 33
"""Length of `ap12.50,bn08.75,cp15.00,dn10.25` with CR LF, bytes. A trailing comma adds one."""

CHECK_BYTES = 8
"""Length of the sequence number and the checksum of a command or a reply (`#07*585F`), bytes."""

SAMPLE_BYTES = 21
"""Length of `@` and the sample fields (the board's clock, four encoder counts) in a reply, bytes.
In a command, the request for the sample fields takes one letter."""

STATUS_BYTES = 28
"""Length of `!status estop=pressed*F4BC`, a typical status line, with CR LF, bytes."""

STATUS_HZ = 10
"""Rate at which a board sends status lines, Hz."""

FIELD = 65536
"""Number of different values of a sample field, which has four hexadecimal digits. The value after
FFFF is 0."""

COMFORTABLE_USE = 0.8
"""Largest advisable use of the wire, as a share of its capacity. If more is used, a slightly late
line delays the next one. The other 20 % also have room for a space after each comma, which makes a
line 36 bytes long instead of 33."""


def wire_ns(count: int, baud_rate: int) -> int:
    """Return the time that `count` bytes occupy the wire, in ns."""
    return count * BITS_PER_BYTE * NS_PER_S // baud_rate


def line_bytes(trailing_comma: bool, check: bool = False, sample: bool = False) -> int:
    """Return the length of a command or of its reply, whichever is longer, bytes.

    Each direction has its own wire, so only the longer line limits the rate. `check` adds a
    sequence number and a checksum. `sample` adds the sample fields.
    """
    checked = PLAIN_BYTES + (CHECK_BYTES if check else 0)
    return max(checked + trailing_comma + sample, checked + (SAMPLE_BYTES if sample else 0))


def wire_use(rate_hz: float, baud_rate: int, count: int) -> float:
    """Return the used share of the wire's capacity. `count` is the length of a line, bytes."""
    return count * BITS_PER_BYTE * rate_hz / baud_rate


def highest_rate(baud_rate: int, count: int, use: float = 1.0) -> int:
    """Return the rate, Hz, at which lines of `count` bytes use the share `use` of the wire."""
    return int(use * baud_rate / (count * BITS_PER_BYTE))
