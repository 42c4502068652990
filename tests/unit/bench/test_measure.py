"""Tests of the configuration that a benchmark gives to its daemon, and of the printed figures."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from acsard.bench.matching import Summary, staircase
from acsard.bench.measure import (
    OWN,
    POINTS,
    Machine,
    Result,
    bench_config,
    table,
    this_machine,
    write,
)
from acsard.config.parsing import parse
from acsard.config.settings import BusConfig, Config, ControlConfig, LimitsConfig, McuConfig
from acsard.runtime.latencies import NAMES


@pytest.mark.parametrize("simulated", [True, False])
def test_it_runs_with_a_name_and_an_address_of_its_own(tmp_path: Path, simulated: bool) -> None:
    users = Config(
        bus=BusConfig(listen=("tls/0.0.0.0:7449",), tls="/etc/acsard/tls"),
        mcu=McuConfig(trailing_comma=True),
    )
    config = bench_config(users, simulated=simulated)
    assert parse(write(config, tmp_path).read_bytes()) == config
    assert config.robot.id != users.robot.id
    assert config.bus.listen[0].startswith("tcp/127.0.0.1:")
    assert not config.bus.tls
    assert config.mcu == users.mcu


def test_on_a_real_port_the_robots_own_limits_and_doubts_stay() -> None:
    users = Config(limits=LimitsConfig(linear_speed=0.2))
    config = bench_config(users, simulated=False)
    assert (config.limits, config.feedback, config.drive) == (
        users.limits,
        users.feedback,
        users.drive,
    )


def test_on_the_simulator_every_speed_is_within_the_limits() -> None:
    config = bench_config(Config(), simulated=True)
    fastest = max(staircase(number) for number in range(1000))
    assert fastest < config.limits.wheel_speed
    assert fastest * config.drive.wheel_radius < config.limits.linear_speed


def test_on_the_simulator_lines_are_plain_and_the_robot_is_active_whatever_is_configured() -> None:
    users = Config(
        mcu=McuConfig(link_check="auto", encoder_counts=3200, trailing_comma=True),
        control=ControlConfig(rate=50.0, auto_activate=False),
    )
    config = bench_config(users, simulated=True)
    assert config.mcu == McuConfig(trailing_comma=True)
    assert config.control == ControlConfig(rate=50.0)
    real = bench_config(users, simulated=False)
    assert (real.mcu, real.control) == (users.mcu, users.control)


RESULT = Result(
    machine=Machine("a processor", 4, "6.1", "3.13.0", "0.1.0", realtime_permitted=False),
    port="simulator",
    simulated=True,
    rate_hz=100.0,
    baud_rate=115200,
    seconds=20.0,
    realtime=False,
    outside={name: Summary(100, 1.0, 20.0, 12345.6) for name in POINTS},
    own={name: Summary(200, 3.0, 40.0, 500.0) for name in OWN},
    commands_sent=375,
    commands_seen=375,
    lines_said=2000,
    lines_told=2000,
    lines_waiting_max=1,
    lines_sent=2000,
    missed_periods=0,
    cpu_percent_following=3.0,
    cpu_percent_commanded=3.5,
    resident_mb=47.1,
    start_up_ms=371.4,
)

REAL = replace(
    RESULT,
    port="/dev/acsar",
    simulated=False,
    outside={"read_to_odometry": Summary(100, 1.0, 20.0, 300.0)},
    commands_seen=None,
    lines_said=None,
    lines_waiting_max=None,
    start_up_ms=None,
)


def test_every_figure_has_its_row_and_all_columns_are_aligned() -> None:
    lines = table(RESULT).splitlines()
    rows = [line for line in lines if line.startswith((*POINTS.values(), *OWN.values()))]
    assert len(rows) == len(POINTS) + len(OWN)
    heads = [line for line in lines if line.endswith("max  us")]
    assert len({len(row) for row in rows} | {len(head) - 4 for head in heads}) == 1
    assert max(map(len, lines)) <= 110


def test_the_table_names_the_machine() -> None:
    text = table(RESULT)
    for part in ("a processor", "4 cores", "Linux 6.1", "Python 3.13.0", "not permitted"):
        assert part in text


def test_the_table_says_that_the_simulator_has_plain_lines() -> None:
    assert "simulated microcontroller, plain lines" in table(RESULT)
    assert "plain lines" not in table(REAL)


def test_what_a_real_port_hides_is_said_to_be_left_out() -> None:
    text = table(REAL)
    assert text.count("not measured") == 3
    assert "zero speeds only" in text
    assert "cannot be seen" in text


def test_json_has_every_figure_by_its_name() -> None:
    plain = msgspec.json.decode(msgspec.json.encode(RESULT))
    assert set(plain) == set(Result.__struct_fields__)
    assert set(plain["outside"]) == set(POINTS)


def test_the_daemons_own_figures_are_all_named() -> None:
    assert tuple(OWN) == NAMES


def test_this_machine_is_named() -> None:
    machine = this_machine()
    assert machine.cpu
    assert machine.cores >= 1
