"""Tests of a benchmark's table: it shows every figure, and marks missing measurements."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from acsard.bench.matching import Summary
from acsard.bench.results_table import OWN, POINTS, Machine, Result, parts, this_machine
from acsard.daemon.latencies import NAMES
from acsard.terminal.output import plain

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
    lines = plain(*parts(RESULT)).splitlines()
    rows = [line for line in lines if line.startswith((*POINTS.values(), *OWN.values()))]
    assert len(rows) == len(POINTS) + len(OWN)
    heads = [line for line in lines if line.endswith("max us")]
    assert len({len(row) for row in rows} | {len(head) for head in heads}) == 1
    assert max(map(len, lines)) <= 110


def test_the_table_names_the_machine() -> None:
    text = plain(*parts(RESULT))
    for part in ("a processor", "4 cores", "Linux 6.1", "Python 3.13.0", "not permitted"):
        assert part in text


def test_the_table_says_that_the_simulator_has_plain_lines() -> None:
    assert "simulated microcontroller, plain lines" in plain(*parts(RESULT))
    assert "plain lines" not in plain(*parts(REAL))


def test_the_table_of_a_real_port_names_the_figures_that_are_not_measured() -> None:
    text = plain(*parts(REAL))
    assert text.count("not measured") == 3
    assert "zero speeds only" in text
    assert "cannot see them on a real port" in text


def test_json_has_every_figure_by_its_name() -> None:
    plain = msgspec.json.decode(msgspec.json.encode(RESULT))
    assert set(plain) == set(Result.__struct_fields__)
    assert set(plain["outside"]) == set(POINTS)


def test_every_figure_of_the_daemon_has_a_label() -> None:
    assert tuple(OWN) == NAMES


def test_the_description_of_this_machine_has_its_processor_and_cores() -> None:
    machine = this_machine()
    assert machine.cpu
    assert machine.cores >= 1
