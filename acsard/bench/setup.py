"""The configuration of the measured daemon: the user's, with some changes, in a file of its own."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from msgspec.structs import replace

from acsard.config.parsing import effective
from acsard.config.settings import (
    BusConfig,
    CommandsConfig,
    Config,
    DriveConfig,
    FeedbackConfig,
    LimitsConfig,
    LogConfig,
    RatesConfig,
    RobotConfig,
    SimConfig,
    Source,
)
from acsard.config.writing import document


def bench_config(config: Config, *, simulated: bool) -> Config:
    """Return the configuration to measure with: it has its own robot id, bus and source.

    With the simulator, a command must reach the next line unchanged, and feedback that does not
    match it must not be a fault. Lines are plain there, because the sequence number of a checked
    line would hide the speed by which it is recognized.
    """
    own = replace(
        config,
        robot=RobotConfig(f"bench-{os.getpid()}"),
        bus=BusConfig(listen=(free_endpoint(),)),
        commands=CommandsConfig(sources=(Source("bench", 100),)),
        rates=RatesConfig(),
        log=LogConfig(),
        control=replace(config.control, state_directory=""),
    )
    if not simulated:
        return own
    return replace(
        own,
        mcu=replace(own.mcu, link_check="off", encoder_counts=0),
        control=replace(own.control, auto_activate=True),
        drive=DriveConfig(),
        feedback=FeedbackConfig(fault_time=0.0),
        limits=LimitsConfig(
            linear_acceleration=100.0,
            linear_deceleration=100.0,
            linear_stop_deceleration=100.0,
            angular_acceleration=500.0,
            angular_deceleration=500.0,
            angular_stop_deceleration=500.0,
        ),
        sim=SimConfig(),
    )


def free_endpoint() -> str:
    """Return a loopback address on which no process listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def write(config: Config, where: Path) -> Path:
    """Write the configuration to a file in the directory `where`."""
    file = where / "acsard.toml"
    file.write_text("\n".join(document(effective(config))) + "\n", encoding="utf-8")
    return file
