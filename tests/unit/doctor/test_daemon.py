"""Tests of the doctor's findings about the two clocks."""

from __future__ import annotations

import socket

import pytest
from msgspec.structs import replace

from acsard.config.settings import BusConfig, Config
from acsard.doctor.daemon import clocks, door, gyro, latch_file, late
from acsard.doctor.running import Running
from acsard.messages.schema import DiagnosticStatus, Time
from tests.unit.doctor.test_running import INFO, STATE

NOW = 1_800_000_000_000_000_000
S = 10**9


def seen(apart: float, trip: float = 0.0, here: bool = False, **counters: int) -> Running:
    """Return the view of a daemon whose clock is `apart` s ahead, queried within `trip` s."""
    state = replace(STATE, stamp=Time.from_ns(NOW + int(apart * S)), counters=counters)
    return Running(INFO, Config(), state, state, NOW, int(trip * S), (), here)


@pytest.mark.parametrize("apart", [0.0, 0.3, -0.3])
def test_clocks_that_agree_are_no_finding(apart: float) -> None:
    assert list(clocks(seen(apart, commands=7))) == []


@pytest.mark.parametrize(
    ("apart", "words"), [(3600.0, "3600.0 s ahead of"), (-0.5, "0.5 s behind")]
)
def test_clocks_that_do_not_are_a_warning_with_its_mend(apart: float, words: str) -> None:
    (finding,) = clocks(seen(apart))
    assert (finding.subject, finding.level) == ("clock", "warning")
    assert words in finding.text
    assert "timedatectl" in finding.mend


def test_an_answer_that_was_late_is_no_clock_that_is_wrong() -> None:
    assert list(clocks(seen(-0.5, trip=1.0))) == list(clocks(seen(0.5, trip=1.0))) == []
    assert len(list(clocks(seen(-2.0, trip=1.0)))) == 1


def test_a_daemon_on_this_machine_has_its_clock() -> None:
    assert list(clocks(seen(-3.0, here=True))) == []


def test_stamps_that_were_replaced_are_told() -> None:
    (finding,) = clocks(seen(0.0, stamps_replaced=12))
    assert "12 commands" in finding.text


def test_periods_that_are_missed_now_are_told_after_months_without() -> None:
    running = seen(0.0, lines_sent=345_600_000, missed_periods=600)
    assert not list(late(running))
    row = DiagnosticStatus(1, "acsard: control loop", "600 of 6000 periods missed", "acsar", [])
    (finding,) = late(replace(running, rows=(row,)))
    assert finding.level == "warning"
    assert "600 of 6000" in finding.text


def test_a_door_is_told_where_it_listens() -> None:
    with socket.create_server(("0.0.0.0", 0)) as door_of_ours:
        endpoint = f"tls/0.0.0.0:{door_of_ours.getsockname()[1]}"
        (finding,) = door(Config(bus=BusConfig(listen=("tcp/127.0.0.1:7448", endpoint))))
    assert (finding.level, finding.text) == ("ok", f"open at {endpoint}")


@pytest.mark.parametrize("does", ["off", "used", "waiting for rest"])
def test_a_gyro_that_does_what_it_should_is_no_warning(does: str) -> None:
    assert [one.level for one in gyro(does, {})] == ([] if does == "off" else ["ok"])


@pytest.mark.parametrize("does", ["silent", "disagrees", "not believed", "what a later one does"])
def test_a_gyro_that_does_not_is_a_warning_with_its_mend(does: str) -> None:
    (finding,) = gyro(does, {})
    assert (finding.subject, finding.level) == ("gyro", "warning")
    assert finding.text
    assert finding.mend


def test_samples_of_a_gyro_that_do_not_count_are_told_by_their_reasons() -> None:
    counters = {"imu_absurd": 3, "imu_second_sender": 12, "imu_not_finite": 0, "lines": 9}
    _, finding = gyro("used", counters)
    assert finding.level == "warning"
    assert "12 second sender, 3 absurd" in finding.text
    assert finding.mend


def test_a_stop_that_would_be_lost_at_a_restart_is_a_warning_with_its_mend() -> None:
    trouble = "a stop cannot be kept over a restart: /x/a.latches.json: Read-only file system"
    (finding,) = latch_file(trouble)
    assert (finding.subject, finding.level, finding.text) == ("latch file", "warning", trouble)
    assert "control.state_directory" in finding.mend
    assert not list(latch_file(""))
