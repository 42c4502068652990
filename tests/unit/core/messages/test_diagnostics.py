"""Tests of the text and level of each row of `diagnostics`."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.codes import Reason, reason
from acsard.core.config.settings import (
    BatteryConfig,
    BusConfig,
    Config,
    ControlConfig,
    FeedbackConfig,
    McuConfig,
    RobotConfig,
    SafetyConfig,
)
from acsard.core.messages.diagnostics import ERROR, OK, SHOW_REFUSAL_S, WARN, diagnostics
from acsard.core.messages.schema import DiagnosticStatus
from acsard.core.motion.bumpers import SILENT_REASON as SILENT_BUMPERS
from acsard.core.values import (
    BatteryLevel,
    BatteryStatus,
    GyroStatus,
    Measured,
    RoutersStatus,
    Snapshot,
    SourceStatus,
    Spread,
    Wait,
    WheelsStatus,
)
from tests.each import each
from tests.stepped import Outputs
from tests.unit.core.messages.examples import OUTPUTS, SNAPSHOT, with_outputs

CONFIG = Config(robot=RobotConfig("r7"), mcu=McuConfig(port="/dev/x"))
BUMPERS = replace(CONFIG, safety=SafetyConfig(bumpers=("front", "rear")))
NO_CERTIFICATE = ("", "")


def rows(
    config: Config = CONFIG, outputs: Outputs = OUTPUTS, snapshot: Snapshot = SNAPSHOT
) -> list[DiagnosticStatus]:
    shot = with_outputs(snapshot, outputs)
    return diagnostics(config, outputs.now, shot, NO_CERTIFICATE).status


def row(name: str, *args: Any, **changes: Any) -> DiagnosticStatus:
    (status,) = [status for status in rows(*args, **changes) if status.name == f"acsard: {name}"]
    return status


def changed_snapshot(**changes: Any) -> Snapshot:
    return replace(SNAPSHOT, **changes)


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values if pair.key != "advice"}


def advice(status: DiagnosticStatus) -> str:
    return "".join(pair.value for pair in status.values if pair.key == "advice")


# names, by which rqt_robot_monitor identifies its rows


def test_every_status_names_its_robot() -> None:
    statuses = rows()
    assert {status.hardware_id for status in statuses} == {"r7"}
    assert len({status.name for status in statuses}) == len(statuses)


@each("mode", ["inactive", "waiting", "stopped", "fault", "shutdown"])
@each("link", ["up", "stale", "booting", "down"])
def test_no_row_appears_or_disappears_in_any_state_of_the_robot(mode: str, link: str) -> None:
    outputs = replace(OUTPUTS, mode=mode, link=link, source="", reason="words")
    snapshot = changed_snapshot(
        figures={}, counters={}, sources=(), refused_age_s=0.0, missed_last_minute=9
    )
    names = [(status.name, status.hardware_id) for status in rows()]
    assert [
        (status.name, status.hardware_id) for status in rows(CONFIG, outputs, snapshot)
    ] == names


@each("does", ["waiting for rest", "waiting for turn", "used", "silent", "dead", "not believed"])
def test_a_configured_gyro_has_a_row_in_each_of_its_states(does: Any) -> None:
    names = [status.name for status in rows(snapshot=changed_snapshot(gyro=GyroStatus(does)))]
    assert set(names) == {"acsard: gyro"} | {status.name for status in rows()}


@each(("estop", "level"), [("", OK), ("released", OK), ("pressed", WARN), ("silent", ERROR)])
def test_a_board_that_sends_status_lines_has_a_row(estop: Any, level: int) -> None:
    counters = {"line_status_malformed": 2, "emergency_stops": 1, "lines": 9}
    status = row(
        "board", snapshot=changed_snapshot(estop=estop, board={"volts": "24.31"}, counters=counters)
    )
    assert status.level == level
    assert values(status) == {
        "volts": "24.31", "line_status_malformed": "2", "emergency_stops": "1",
    }  # fmt: skip


def test_a_required_emergency_stop_has_a_row_before_the_board_reports_it() -> None:
    config = replace(CONFIG, safety=SafetyConfig(estop="required"))
    status = row("board", config)
    assert status.level == ERROR
    assert row("board", config, snapshot=changed_snapshot(estop="released")).level == OK


@each(
    ("bumpers", "why", "level"),
    [
        (None, None, ERROR),
        ((False, False), None, OK),
        ((True, False), reason("bumper", bumpers="front bumper pressed"), WARN),
        ((True, True), SILENT_BUMPERS, ERROR),
    ],
)
def test_the_row_of_the_board_shows_the_state_of_its_bumpers(
    bumpers: Any, why: Reason | None, level: int
) -> None:
    counters = {"bumper_presses": 1, "lines": 9}
    snapshot = changed_snapshot(estop="released", bumpers=bumpers, bumper=why, counters=counters)
    status = row("board", BUMPERS, snapshot=snapshot)
    assert status.level == level
    assert values(status) == {"bumper_presses": "1"}


def test_ignored_bumpers_need_no_row() -> None:
    off = replace(BUMPERS, safety=replace(BUMPERS.safety, bumper="off"))
    assert "acsard: board" not in [status.name for status in rows(off)]


def test_a_motor_drivers_fault_is_an_error_of_the_board() -> None:
    status = row("board", snapshot=changed_snapshot(board={"motor_driver": "fault"}))
    assert status.level == ERROR


BATTERY = replace(CONFIG, battery=BatteryConfig(warning_below=22.0, stop_below=21.0))


@each(("level", "number"), [("ok", OK), ("warning", WARN), ("stop", ERROR), ("unknown", WARN)])
def test_a_battery_that_the_board_reports_has_a_row(level: BatteryLevel, number: int) -> None:
    status = BatteryStatus(level, 0, 22.5, 40.0, -1.5, 21.756)
    entry = row("battery", BATTERY, snapshot=changed_snapshot(battery=status))
    assert entry.level == number
    assert values(entry) == {
        "level": level, "volts": "22.50", "percent": "40.00", "amperes": "-1.50", "mean": "21.76",
        "warning_below": "22", "stop_below": "21",
    }  # fmt: skip


def test_a_battery_has_a_row_once_it_is_reported_or_has_thresholds() -> None:
    assert "acsard: battery" not in {
        status.name for status in rows(snapshot=changed_snapshot(battery=None))
    }
    status = row("battery", BATTERY, snapshot=changed_snapshot(battery=None))
    assert status.level == WARN
    status = row(
        "battery", snapshot=changed_snapshot(battery=BatteryStatus("ok", 0, 24.0, mean=24.0))
    )
    assert values(status) == {"level": "ok", "volts": "24.00"}


def test_a_router_has_a_row_before_the_first_check_of_its_connection() -> None:
    """The first check of the routers takes half a second.

    Without a row from the start, a new row would appear in the monitor after this time.
    """
    config = replace(CONFIG, bus=BusConfig(connect=("tcp/a:7447",)))
    status = row("router", config)
    assert status.level == OK
    assert values(status) == {"tcp/a:7447": "not connected yet"}
    looked = changed_snapshot(routers=RoutersStatus(missing=("tcp/a:7447",)))
    assert [of.name for of in rows(config, snapshot=looked)] == [of.name for of in rows(config)]


def test_a_lost_router_is_named_although_another_one_was_never_connected() -> None:
    config = replace(CONFIG, bus=BusConfig(connect=("tcp/a:7447", "tcp/b:7447")))
    status = row(
        "router", config, snapshot=changed_snapshot(routers=RoutersStatus(missing=("tcp/a:7447",)))
    )
    assert status.level == WARN
    assert values(status) == {"tcp/a:7447": "not connected", "tcp/b:7447": "not connected yet"}


# advice


BUSY = {"lines": 9_000, "lines_sent": 9_000}
ADVICE: dict[str, tuple[str, Config, dict[str, Any], str]] = {
    "a stop": ("mode", CONFIG, {"mode": "stopped"}, "acsard call clear"),
    "a fault": ("mode", CONFIG, {"mode": "fault", "code": "driver_fault"}, "acsard call clear"),
    "a fault of acsard": ("mode", CONFIG, {"mode": "fault", "code": "guard_too_fast"}, "report it"),
    "a link that is down": ("serial link", CONFIG, {"link": "down"}, "mcu check --port /dev/x"),
    "a late computer": ("serial link", CONFIG, {"link": "stale", "code": "host_late"}, "`top`"),
    "lines without answers": ("serial link", CONFIG, {"unanswered": True}, "mcu check"),
    "damaged lines": (
        "serial link", CONFIG, {"counters": BUSY | {"line_malformed": 200}}, "mcu check"
    ),
    "links that this computer lost": (
        "serial link", CONFIG, {"counters": BUSY | {"link_lost": 3, "link_lost_host_stall": 3}},
        "`top`",
    ),
    "links that the board lost": (
        "serial link", CONFIG, {"counters": BUSY | {"link_lost": 3}}, "mcu check"
    ),
    "the simulator": ("serial link", Config(), {}, "acsard ports"),
    "missed periods": ("control loop", CONFIG, {"missed_last_minute": 900}, "`top`"),
    "a blocked wheel": ("wheels", CONFIG, {"doubt": WheelsStatus(text="blocked")}, "mcu check"),
    "no encoders": (
        "wheels", replace(CONFIG, feedback=FeedbackConfig(encoders=False)),
        {"doubt": WheelsStatus(text="no encoders")}, "feedback.encoders = true",
    ),
    "a pressed emergency stop": ("board", CONFIG, {"estop": "pressed", "board": {"a": "1"}},
                                 "release it"),
    "missing bumpers": ("board", BUMPERS, {}, "mcu check"),
    "an empty battery": ("battery", CONFIG, {"battery": BatteryStatus("stop", 0, 20.0)}, "charge"),
    "a dead gyro": ("gyro", CONFIG, {"gyro": GyroStatus("dead")}, "cable"),
    "a lost router": (
        "router", replace(CONFIG, bus=BusConfig(connect=("tcp/a:7447",))),
        {"routers": RoutersStatus(missing=("tcp/a:7447",))}, "acsard router",
    ),
    "a full disk": ("latch file", CONFIG, {"latch_file": "No space left"}, "free disk space"),
    "changed settings": ("settings", CONFIG, {"settings_differ": "rates.odom = 5"}, "--keep"),
}  # fmt: skip


@pytest.mark.parametrize("situation", ADVICE)
def test_a_row_that_is_not_ok_says_what_a_person_can_do(situation: str) -> None:
    name, config, changes, words = ADVICE[situation]
    of_status = {key: changes[key] for key in ("mode", "code", "link") if key in changes}
    snapshot = replace(
        SNAPSHOT,
        status=replace(SNAPSHOT.status, **of_status),
        **{key: value for key, value in changes.items() if key not in of_status},
    )
    statuses = diagnostics(config, OUTPUTS.now, snapshot, NO_CERTIFICATE).status
    (status,) = [status for status in statuses if status.name == f"acsard: {name}"]
    assert status.level > OK
    assert words in advice(status)


def test_a_link_that_was_lost_less_than_once_a_day_is_ok() -> None:
    days_40 = {"lines": 340_000_000, "lines_sent": 345_600_000}
    for lost, level in ((40, OK), (41, WARN)):
        snapshot = changed_snapshot(counters=days_40 | {"link_lost": lost})
        assert row("serial link", snapshot=snapshot).level == level


# mode


@each(
    ("mode", "level"),
    [
        ("driving", OK),
        ("ready", OK),
        ("waiting", OK),
        ("inactive", OK),
        ("shutdown", OK),
        ("stopped", WARN),
        ("fault", ERROR),
    ],
)
def test_a_latched_mode_is_not_ok_and_its_reason_is_the_message(mode: str, level: int) -> None:
    status = row("mode", outputs=replace(OUTPUTS, mode=mode, reason="words"))
    assert (status.level, status.message) == (level, "words")
    assert values(status) == {"mode": mode, "code": "commanded", "source": "app"}


# link


@each(("link", "level"), [("up", OK), ("stale", ERROR), ("booting", ERROR), ("down", ERROR)])
def test_a_link_that_is_not_up_is_an_error(link: str, level: int) -> None:
    status = row("serial link", outputs=replace(OUTPUTS, link=link))
    assert (status.level, status.message) == (level, link)


@pytest.mark.parametrize(("link", "level"), [("up", WARN), ("down", ERROR)])
def test_the_row_of_the_link_says_that_the_robot_is_simulated(link: str, level: int) -> None:
    status = row("serial link", Config(), replace(OUTPUTS, link=link))
    assert status.level == level
    assert "simulator" in status.message


def test_the_link_shows_its_port_its_wire_use_and_its_rejects_by_reason() -> None:
    mcu, control = McuConfig(port="/dev/x", baud_rate=38400), ControlConfig(rate=50)
    status = row("serial link", replace(CONFIG, mcu=mcu, control=control))
    assert values(status) == {
        "port": "/dev/x",
        "wire_use": "0.43",  # 50 lines a second of 33 bytes with 10 bits each, on 38400 baud
        "check": "plain",
        "lines": "100",
        "line_malformed": "2",
    }


# control loop


@pytest.mark.parametrize(("missed", "level"), [(0, OK), (1, OK), (2, WARN)])
def test_more_than_one_period_in_a_hundred_missed_in_the_last_minute_is_a_warning(
    missed: int, level: int
) -> None:
    status = row("control loop", snapshot=changed_snapshot(missed_last_minute=missed))
    assert status.level == level
    assert values(status) == {
        "period_lateness_p50_us": "50",
        "period_lateness_p99_us": "400",
        "period_lateness_max_us": "900",
        "period_lateness_minute_p50_us": "40",
        "period_lateness_minute_p99_us": "80",
        "period_lateness_minute_max_us": "90",
    }


def test_periods_missed_an_hour_ago_are_counted_but_cause_no_warning() -> None:
    status = row("control loop", snapshot=changed_snapshot(counters={"missed_periods": 100_000}))
    assert (status.level, values(status)["missed_periods"]) == (OK, "100000")


def test_a_bad_minute_is_a_warning_after_any_number_of_good_hours() -> None:
    long = {"period_lateness": Measured(Spread(10_000_000), Spread(5_800))}
    assert (
        row("control loop", snapshot=changed_snapshot(figures=long, missed_last_minute=200)).level
        == WARN
    )


# commands


def test_the_commands_show_what_each_source_waits_for_and_what_was_refused() -> None:
    status = row("commands")
    assert (status.level, status.message) == (OK, "commanded by app")
    assert values(status) == {
        "app": "driving",
        "nav": "a command",
        "commands": "7",
        "command_stale": "3",
    }
    assert row("commands", outputs=replace(OUTPUTS, source="")).message == "waiting for a command"


def test_the_commands_name_the_speed_limit_that_slows_the_robot() -> None:
    status = row("commands", snapshot=replace(SNAPSHOT, speed_limit="0.3 m/s, set by x"))
    assert (status.level, status.message) == (
        OK,
        "commanded by app; speed limit: 0.3 m/s, set by x",
    )


def test_two_senders_of_one_source_are_a_warning_that_names_the_source() -> None:
    two = SourceStatus("nav", 10, 0.1, Wait("senders", senders=1))
    alone = SourceStatus("app", 50, 0.1, Wait("nothing"))
    status = row("commands", snapshot=changed_snapshot(sources=(alone, two)))
    assert (status.level, "2 programs send as nav" in status.message) == (WARN, True)
    assert row("commands", snapshot=changed_snapshot(sources=(alone,))).level == OK


def test_a_refused_source_makes_the_commands_a_warning_with_the_reason() -> None:
    status = row("commands", snapshot=changed_snapshot(refused_age_s=SHOW_REFUSAL_S / 2))
    assert (status.level, status.message) == (
        WARN,
        "commanded by app; refused: source nav: held up",
    )
    later = row("commands", snapshot=changed_snapshot(refused_age_s=SHOW_REFUSAL_S))
    assert (later.level, later.message) == (OK, "commanded by app")
