"""The sample fields against the speeds: encoder counts per wheel turn, and how far a motor ran."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

from msgspec import Struct

from acsard.checkup.bench import Bench
from acsard.checkup.findings import Finding
from acsard.checkup.motion import Reply, difference
from acsard.config.baud import FIELD

LEAST_ANGLE = 2.0
"""rad; over less the speeds' own rounding spoils the figure."""

AGREES = 0.02
"""By which share the measured counts may differ from those stated."""

MOST_COUNTS = 100_000
"""What `mcu.encoder_counts` takes."""


class Leg(Struct, frozen=True):
    """From one sampled reply to the next: counts by encoder, and ms, by the MCU itself."""

    counts: tuple[int, ...]
    ms: int
    speeds: tuple[float, ...]
    """rad/s, of the second reply: what it measured over the leg."""


def legs(replies: Sequence[Reply]) -> Iterator[Leg]:
    """The legs between sampled replies; the clock and counts wrap at 65536."""
    for before, after in pairwise(replies):
        if before.reading is not None and after.reading is not None:
            yield Leg(
                difference(before.reading, after.reading),
                (after.reading.mcu_ms - before.reading.mcu_ms) % FIELD,
                after.motors,
            )


def per_turn(replies: Sequence[Reply], motors: Sequence[int]) -> float | None:
    """Counts per turn of these motors' encoders, by the speeds the MCU says; None: too little."""
    counts = angle = 0.0
    for leg in legs(replies):
        for motor in motors:
            if abs(leg.speeds[motor]) < 1.0 or leg.ms > 200:
                continue
            forth = math.copysign(1.0, leg.speeds[motor])
            counts += forth * leg.counts[motor]
            angle += forth * leg.speeds[motor] * leg.ms / 1000
    return counts / angle * math.tau if angle >= LEAST_ANGLE else None


def finding(bench: Bench, motors: Sequence[int]) -> Finding:
    """`mcu.encoder_counts`, from the identification or measured; `motors` have moved right."""
    name = "encoder counts"
    if not bench.sampled:
        return Finding(name, "SKIPPED", "", "the firmware sends no counts")
    measured = per_turn(bench.replies, motors)
    named = bench.identity.get("counts", "")
    stated = int(named) if named.isdigit() and len(named) < 9 else 0
    if measured is None:
        if not stated:
            return Finding(name, "SKIPPED", "", "too little was turned to measure them")
        return _stated(bench, stated, "by its identification; not measured")
    if measured < 1:
        text = "counts run against the speeds, or stand: the pose would run backward"
        mend = "the firmware must count up when a motor turns in its p direction"
        return Finding(name, "FAIL", f"{measured:.0f} per turn", text, mend, _off(bench))
    if not stated:
        text = f"measured against its speeds, {measured:.0f} within {AGREES:.0%}"
        configured = bench.mcu.encoder_counts
        near = abs(measured - configured) <= AGREES * configured
        return _stated(bench, configured if near else round(measured), text)
    if abs(measured - stated) <= AGREES * stated:
        return _stated(bench, stated, f"by its identification; measured {measured:.0f}")
    text = f"it names {stated} per turn, but by its speeds there are {measured:.0f}"
    return Finding(
        name, "FAIL", f"{measured:.0f}", text, "the firmware's counts per turn or speeds"
    )


def _stated(bench: Bench, counts: int, text: str) -> Finding:
    if counts > MOST_COUNTS:
        text = f"more than the {MOST_COUNTS} the host takes: count fewer edges"
        return Finding("encoder counts", "WARN", f"{counts} per turn", text, "", _off(bench))
    keys: dict[str, object] = {"mcu.encoder_counts": counts}
    configured = bench.mcu.encoder_counts
    if configured in (0, counts):
        return Finding("encoder counts", "PASS", f"{counts} per turn", text, "", keys)
    return Finding(
        "encoder counts",
        "FAIL",
        f"{counts}, not {configured}",
        f"{text}: every distance would be off by {abs(configured / counts - 1):.1%}",
        f"write mcu.encoder_counts = {counts}",
        keys,
    )


def _off(bench: Bench) -> dict[str, object]:
    return {"mcu.encoder_counts": 0} if bench.mcu.encoder_counts else {}
