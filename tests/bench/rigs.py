"""Helpers of the benchmarks: run a program on the rig, and compute statistics."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from msgspec.structs import replace

from acsard.core.config.parsing import effective
from acsard.core.config.settings import (
    BusConfig,
    CommandsConfig,
    Config,
    FeedbackConfig,
    LimitsConfig,
    RobotConfig,
    Source,
)
from acsard.core.config.toml_text import document
from tests.bench.matching import Record, command_waits, feedback_delays, staircase
from tests.bench.rig import ACSARD, Rig
from tests.system.harness import free_endpoint

POLLED = (sys.executable, "-m", "tests.bench.polled")
"""The original driver's method."""

DRAINING = (*POLLED, "--drain")
"""The polled driver with its obvious fix."""


def config() -> Config:
    """Return the configuration of a measured daemon, with its own robot id and bus.

    The limits are so high that the line after a command has exactly the speeds of the command, and
    feedback that contradicts the commands is not a fault.
    """
    return Config(
        robot=RobotConfig(f"bench-{os.getpid()}"),
        bus=BusConfig(listen=(free_endpoint(),)),
        commands=CommandsConfig(sources=(Source("bench", 100),)),
        feedback=FeedbackConfig(encoders=False),
        limits=LimitsConfig(
            linear_acceleration=100.0,
            linear_deceleration=100.0,
            linear_stop_deceleration=100.0,
            angular_acceleration=500.0,
            angular_deceleration=500.0,
            angular_stop_deceleration=500.0,
        ),
    )


def sibling(settings: Config, number: int) -> Config:
    """Return a copy of the configuration with another robot id and another bus address."""
    name, bus = RobotConfig(f"{settings.robot.id}-{number}"), BusConfig(listen=(free_endpoint(),))
    return replace(settings, robot=name, bus=bus)


@contextmanager
def rig(
    settings: Config,
    words: Sequence[str] = ACSARD,
) -> Iterator[Rig]:
    """Start a program and a simulated board. The body runs when the link between them is up."""
    with TemporaryDirectory(prefix="acsard-bench-") as where:
        file = Path(where) / "acsard.toml"
        file.write_text("\n".join(document(effective(settings))) + "\n", encoding="utf-8")
        with Rig(settings, file, words) as running:
            yield running


def driven(settings: Config, words: Sequence[str], seconds: float, seed: int) -> Record:
    """Send commands to the program for this many seconds, and return the record of all messages."""
    with rig(settings, words) as running:
        running.command(seconds, staircase, seed)
        return running.end()


def waits_us(record: Record) -> list[float]:
    """Return the time from each command to the first byte of its line on the port, in us."""
    return [wait / 1000 for wait in command_waits(record)]


def delays_us(settings: Config, record: Record) -> list[float]:
    """Return the time from each feedback line's last byte on the wire to its odometry, in us.

    The odometry counts when this process receives it from the bus.
    """
    return [delay / 1000 for delay in feedback_delays(settings, record)]


def share(values: Sequence[float], part: float) -> float:
    """Return the quantile `part` (0 to 1) of the values, for example 0.99 for p99."""
    return sorted(values)[min(len(values) - 1, int(part * len(values)))]
