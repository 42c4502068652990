"""Computes the bytes that a receiver gets if the sender uses another baud rate.

A byte is a start bit, eight data bits with the lowest first, and a stop bit. The receiver waits for
a falling edge and samples ten times, in the middle of each bit at its own baud rate.
"""

from __future__ import annotations

BITS = 10


def garbled(data: bytes, sent: int, received: int) -> bytes:
    """Return what a receiver at `received` baud gets of `data` that is sent at `sent` baud.

    A byte with a wrong stop bit becomes a zero byte, as the Linux kernel delivers it.
    """
    if sent == received or not data:
        return data
    levels = [bit for byte in data for bit in (0, *(byte >> n & 1 for n in range(8)), 1)]
    step = sent / received
    output, at, end = bytearray(), 0.0, len(levels)

    def level(when: float) -> int:
        return levels[int(when)] if when < end else 1

    while at < end:
        if level(at):
            at = int(at) + 1.0  # the wire is idle: skip to the next bit
            continue
        bits = [level(at + (n + 0.5) * step) for n in range(BITS)]
        if bits[0]:
            at += step  # too short for a start bit
            continue
        byte = sum(bit << n for n, bit in enumerate(bits[1:9]))
        output.append(byte if bits[9] else 0)
        at += (BITS - 0.5) * step
        while at < end and not level(at):
            at = int(at) + 1.0  # a break: the next start bit comes after its end at the earliest
    return bytes(output)
