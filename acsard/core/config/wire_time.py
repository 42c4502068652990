"""Computes how long lines take on the serial wire, and how many lines fit on it."""

from __future__ import annotations

from functools import lru_cache

from acsard.core.values import NS_PER_S, Ns

BITS_PER_BYTE = 10  # 8N1: a start bit, eight data bits and a stop bit

# `ap12.50,` of each motor; CR LF instead of the last comma. A trailing comma is one more.
TOKEN_BYTES, END_BYTES = 8, 1

CHECK_BYTES = 8  # sequence number and checksum, `#07*585F`

# `@` with the board's time, and the count of each motor, in a reply; a command asks by one letter.
TIME_BYTES, COUNT_BYTES = 5, 4

STATUS_BYTES = 28  # `!status estop=pressed*F4BC` with CR LF, a typical status line

STATUS_HZ = 10  # of status lines

FIELD_VALUES = 65536  # of a sample field with four hexadecimal digits

# Share of the wire's capacity above which a slightly late line delays the next one. The rest
# suffices for a space after each comma (36 bytes instead of 33).
COMFORTABLE_USE = 0.8


@lru_cache(256)
def wire_ns(count: int, baud_rate: int) -> Ns:
    """Return how long `count` bytes take on the wire."""
    return count * BITS_PER_BYTE * NS_PER_S // baud_rate


def plain_bytes(motors: int) -> int:
    """Return the bytes of a plain line with its end, such as 17 for `lp08.75,rp12.50`."""
    return TOKEN_BYTES * motors + END_BYTES


def line_bytes(motors: int, trailing_comma: bool, check: bool = False, sample: bool = False) -> int:
    """Return the bytes of a command or its reply, whichever is longer.

    Each direction has its own wire, so only the longer one limits the rate.
    """
    checked = plain_bytes(motors) + (CHECK_BYTES if check else 0)
    fields = TIME_BYTES + COUNT_BYTES * motors
    return max(checked + trailing_comma + sample, checked + (fields if sample else 0))


def wire_use(rate_hz: float, baud_rate: int, count: int) -> float:
    """Return the fraction of the wire's capacity; above 1, the lines do not fit."""
    return count * BITS_PER_BYTE * rate_hz / baud_rate


def highest_rate(baud_rate: int, count: int, use: float = 1.0) -> int:
    """Return the highest whole rate, Hz, of lines of `count` bytes within `use` of the wire."""
    return int(use * baud_rate / (count * BITS_PER_BYTE))
