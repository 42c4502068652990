"""What a receiver makes of bytes that were sent at another baud rate than its own.

The line as it is: start bit, eight data bits with the lowest first, stop bit; the receiver waits
for an edge and then samples in the middles of its own bits.
"""

from __future__ import annotations

BITS = 10


def garbled(data: bytes, sent: int, heard: int) -> bytes:
    """The bytes a receiver at `heard` baud gets from `data` at `sent` baud; one with a wrong stop
    bit is read as zero, as the kernel hands it out."""
    if sent == heard or not data:
        return data
    levels = [bit for byte in data for bit in (0, *(byte >> n & 1 for n in range(8)), 1)]
    step = sent / heard
    got, at, end = bytearray(), 0.0, len(levels)

    def level(when: float) -> int:
        return levels[int(when)] if when < end else 1

    while at < end:
        if level(at):
            at = int(at) + 1.0  # idle: on to where the next bit begins
            continue
        bits = [level(at + (n + 0.5) * step) for n in range(BITS)]
        if bits[0]:
            at += step  # too short for a start bit
            continue
        byte = sum(bit << n for n, bit in enumerate(bits[1:9]))
        got.append(byte if bits[9] else 0)
        at += (BITS - 0.5) * step
        while at < end and not level(at):
            at = int(at) + 1.0  # a break: not a start before it has ended
    return bytes(got)
