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
"""Largest advisable use of the serial wire, as a fraction of its capacity. If the lines use more,
one line that is slightly late delays the next one. The remaining 20 % also suffice for a board that
writes a space after each comma, so that its lines have 36 bytes instead of 33."""


def wire_ns(count: int, baud_rate: int) -> int:
    """Return the time in ns that the serial wire needs to transmit `count` bytes."""
    return count * BITS_PER_BYTE * NS_PER_S // baud_rate


def line_bytes(trailing_comma: bool, check: bool = False, sample: bool = False) -> int:
    """Return the length in bytes of a command line or of its reply, whichever is longer.

    Each direction has its own wire, so only the longer line limits the rate. `trailing_comma` adds
    a comma after the last wheel speed, `check` a sequence number and a checksum. `sample` adds the
    sample fields to the reply, and one letter to the command.
    """
    checked = PLAIN_BYTES + (CHECK_BYTES if check else 0)
    return max(checked + trailing_comma + sample, checked + (SAMPLE_BYTES if sample else 0))


def wire_use(rate_hz: float, baud_rate: int, count: int) -> float:
    """Return the fraction of the wire's capacity that lines use; above 1 they do not fit.

    `count` is the length of each line, bytes.
    """
    return count * BITS_PER_BYTE * rate_hz / baud_rate


def highest_rate(baud_rate: int, count: int, use: float = 1.0) -> int:
    """Return the highest rate in Hz, rounded down, at which lines fit into a part of the wire.

    `count` is the length of each line, bytes. `use` is the fraction of the wire's capacity that the
    lines may use.
    """
    return int(use * baud_rate / (count * BITS_PER_BYTE))
