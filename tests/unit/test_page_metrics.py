"""Metrics in Prometheus' text format, and the log of refusals."""

from __future__ import annotations

from msgspec.structs import replace
from prometheus_client.parser import text_string_to_metric_families

from acsard.core.messages.schema import BatterySummary, Latency, RobotState, Spread, Time
from acsard.core.messages.state_warnings import WARNING_KINDS
from acsard.web.metrics import MAX_COUNTED_CLIENTS, Counts, text

SPREAD = Spread(10, 5.0, 20.0, 80.0)

STATE = RobotState(
    Time(1, 0), "driving", "commanded by app", 1.0, 2.0, 0.5, 0.25, -0.5,
    [1.0, 2.0, 3.0, 4.0], "up", "app", [], "", {"lines": 7, "missed_periods": 2},
    latencies={
        "period_lateness": Latency(SPREAD, SPREAD),
        "mcu_round_trip": Latency(SPREAD, Spread(0, 0.0, 0.0, 0.0)),
    },
)  # fmt: skip


def parsed(exposition: bytes) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Parse metrics with Prometheus' own client, and return the samples by name and labels.

    Each metric must have a type, and no two samples may have the same name and labels.
    """
    samples: dict[tuple[str, frozenset[tuple[str, str]]], float] = {}
    for family in text_string_to_metric_families(exposition.decode()):
        assert family.type in ("gauge", "counter"), family
        for sample in family.samples:
            assert (family.type == "counter") == sample.name.endswith("_total")
            key = sample.name, frozenset(sample.labels.items())
            assert key not in samples
            samples[key] = float(sample.value)
    return samples


def test_the_state_of_the_robot_becomes_samples_with_labels() -> None:
    samples = parsed(
        text("acsar", "0.1.0+g1a2b3c4d5", STATE, True, 3, {"commands": 4}, {"host": 5})
    )
    own = ("robot", "acsar")
    assert samples["acsard_up", frozenset({own})] == 1
    assert samples["acsard_mode", frozenset({own, ("mode", "driving")})] == 1
    assert samples["acsard_mode", frozenset({own, ("mode", "stopped")})] == 0
    assert samples["acsard_linear_speed_mps", frozenset({own})] == 0.25
    assert samples["acsard_robot_total", frozenset({own, ("what", "missed_periods")})] == 2
    late = frozenset({own, ("latency", "period_lateness"), ("at", "p99")})
    assert abs(samples["acsard_latency_seconds", late] - 20e-6) < 1e-12
    assert not [labels for _, labels in samples if ("latency", "mcu_round_trip") in labels]
    assert samples["acsard_page_viewers", frozenset({own})] == 3
    assert samples["acsard_page_total", frozenset({own, ("what", "commands")})] == 4
    assert samples["acsard_page_refused_total", frozenset({own, ("reason", "host")})] == 5


def test_a_silent_robot_is_down_and_reports_no_old_speed() -> None:
    samples = parsed(text("acsar", "0.1.0+g1a2b3c4d5", STATE, False, 0, {}, {}))
    assert samples["acsard_up", frozenset({("robot", "acsar")})] == 0
    assert not any(name == "acsard_linear_speed_mps" for name, _ in samples)


def test_each_warning_of_a_later_failure_is_a_sample() -> None:
    own = ("robot", "acsar")
    ends = replace(STATE, certificate="expires", certificate_days=10.0)
    samples = parsed(text("acsar", "0.1.0+g1a2b3c4d5", ends, True, 0, {}, {}))
    assert samples["acsard_info", frozenset({own, ("version", "0.1.0+g1a2b3c4d5")})] == 1
    warned = {dict(labels)["what"]: n for (name, labels), n in samples.items() if "warning" in name}
    assert warned == dict.fromkeys(WARNING_KINDS, 0.0) | {"certificate": 1.0}
    assert samples["acsard_certificate_seconds", frozenset({own})] == 864_000


def test_the_inputs_and_the_battery_of_the_board_are_samples_if_it_reports_them() -> None:
    own = ("robot", "acsar")
    board = replace(
        STATE,
        emergency_stop="silent",
        bumpers=[False, True],
        battery=BatterySummary(24.5, 87.0, None, "ok"),
    )
    samples = parsed(text("acsar", "1", board, True, 0, {}, {}))
    assert samples["acsard_emergency_stop", frozenset({own})] == 1
    assert [samples["acsard_bumper", frozenset({own, ("bumper", n)})] for n in "12"] == [0, 1]
    assert samples["acsard_battery_volts", frozenset({own})] == 24.5
    assert samples["acsard_battery_charge_ratio", frozenset({own})] == 0.87
    assert not any(name == "acsard_battery_amperes" for name, _ in samples)
    none = parsed(text("acsard", "1", STATE, True, 0, {}, {}))
    assert not any(word in name for name, _ in none for word in ("emergency", "bumper", "battery"))


def test_each_line_names_the_client_with_the_most_refusals_since_the_last_line() -> None:
    counts = Counts()
    for _ in range(3):
        counts.refuse("role", "192.168.1.50 (tv)")
    counts.refuse("bad_token", "192.168.1.7")
    counts.refuse("slow")
    event = counts.new_refusals()
    assert event is not None
    assert event.text == (
        "3 role, 1 bad token, 1 slow; 3 from 192.168.1.50 (tv), 1 from 192.168.1.7, 1 from others"
    )
    counts.refuse("role", "192.168.1.7")
    event = counts.new_refusals()
    assert event is not None
    assert event.text == "1 role; 1 from 192.168.1.7"
    counts.refuse("slow")
    event = counts.new_refusals()
    assert event is not None
    assert (event.name, event.level, event.count) == ("page_refused", "warning", 1)
    assert event.text == "1 slow"
    assert counts.new_refusals() is None


def test_refusals_of_many_addresses_take_bounded_memory_and_keep_the_first_ones() -> None:
    counts = Counts()
    for number in range(MAX_COUNTED_CLIENTS):
        counts.refuse("role", f"first {number}")
    for _ in range(2):
        counts.refuse("role", "first 0")
        counts.refuse("role", "late")
    event = counts.new_refusals()
    assert event is not None
    assert "3 from first 0" in event.text
    assert "late" not in event.text
