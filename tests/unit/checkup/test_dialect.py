"""The language of the MCU, step by step."""

from __future__ import annotations

from typing import Any

import pytest

from acsard.checkup import dialect
from acsard.checkup.findings import StoppedError
from acsard.config.settings import Config, McuConfig
from tests.unit.checkup.robots import Checked, Robot


@pytest.mark.parametrize("rate", [9600, 19200, 38400, 57600])
def test_the_rate_it_speaks_at_is_found_and_used(rate: Any) -> None:
    with Robot(config=Config(mcu=McuConfig(baud_rate=rate)), baud_rate=115200).bench(
        rest=False
    ) as bench:
        finding = dialect.baud(bench)
        assert finding.verdict == "FAIL"
        assert finding.keys == {"mcu.baud_rate": rate}
        assert bench.baud_rate == rate


def test_garbage_is_told_from_silence() -> None:
    for fault, word in (("mute", "nothing"), ("noise", "only garbage")):
        with Robot(fault).bench(rest=False) as bench, pytest.raises(StoppedError) as end:
            dialect.baud(bench)
        assert end.value.finding.figure.startswith(word)


def test_the_identification_is_kept_and_missed_without_fault() -> None:
    with Robot().bench() as bench:
        assert dialect.identity(bench).figure == "acsard-mcu 1"
        assert bench.identity["counts"] == "3200"
    with Robot("plain_only").bench() as bench:
        assert dialect.identity(bench).verdict == "PASS"
        assert bench.identity == {}


@pytest.mark.parametrize(
    ("faults", "figure"),
    [
        ((), "as documented"),
        (("spaces",), "spaces"),
        (("unpadded", "trailing_comma"), "unpadded, trailing comma"),
    ],
)
def test_the_form_of_its_replies_is_told(faults: tuple[str, ...], figure: str) -> None:
    with Robot(*faults).bench() as bench:
        assert dialect.forms(bench).figure == figure


@pytest.mark.parametrize(
    ("faults", "mcu", "verdict", "own"),
    [
        ((), {}, "PASS", False),
        (("sparse_replies",), {}, "FAIL", False),
        (("sparse_replies",), {"reply_period": 0.1}, "WARN", False),
        (("unprompted",), {}, "FAIL", True),
        (("unprompted",), {"reply_period": 0.1}, "PASS", True),
    ],
)
def test_the_pace_is_judged_by_what_the_host_waits_for(
    faults: tuple[str, ...], mcu: dict[str, Any], verdict: str, own: bool
) -> None:
    with Robot(*faults, **mcu).bench() as bench:
        rate, trip = dialect.pace(bench)
        assert rate.verdict == verdict
        assert bench.own_clock is own
        assert trip.verdict == ("SKIPPED" if own else "PASS")
        assert rate.keys == ({"mcu.reply_period": 0.1} if faults else {})


def test_a_slow_answer_is_a_warning() -> None:
    with Robot("slow_reply").bench() as bench:
        _, trip = dialect.pace(bench)
        assert trip.verdict == "WARN"
        assert "latency_timer" in trip.mend


class Particular(Robot):
    """Takes lines with a comma at their end only, or without only."""

    def __init__(self, comma: bool, **mcu: Any) -> None:
        super().__init__("plain_only", **mcu)
        self._comma = comma

    def send(self, data: bytes) -> None:
        lines = data.splitlines(keepends=True)
        super().send(b"".join(s for s in lines if s.endswith(b",\r\n") == self._comma))


def test_firmware_that_refuses_plain_lines_is_found_and_checked_to_the_end() -> None:
    class Refuses(Robot):
        def send(self, data: bytes) -> None:
            super().send(b"".join(s for s in data.splitlines(keepends=True) if b"p" not in s
                                  or b"#" in s))  # fmt: skip

    assert Checked(Refuses()).failed == []


def test_firmware_that_answers_nearly_nothing_fails() -> None:
    with Robot("plain_only").bench() as bench, bench.wire.mcu.mute():  # type: ignore[attr-defined]
        bench.armed = False
        rate, trip = dialect.pace(bench)
    assert (rate.verdict, trip.verdict) == ("FAIL", "SKIPPED")


@pytest.mark.parametrize("comma", [False, True])
def test_a_form_of_line_that_is_not_answered_is_left_for_the_other(comma: bool) -> None:
    with Particular(comma, trailing_comma=comma).bench() as bench:
        assert dialect.comma(bench) is None
    robot = Particular(comma)
    with robot.faulty():
        from acsard.checkup.bench import Bench

        with Bench(robot, McuConfig(trailing_comma=not comma), 100.0) as bench:
            bench.open(115200)
            finding = dialect.comma(bench)
            assert finding is not None
            assert finding.keys == {"mcu.trailing_comma": comma}
            assert bench.comma is comma


@pytest.mark.parametrize(
    ("faults", "wanted", "verdict", "keys"),
    [
        ((), "off", "PASS", {"mcu.link_check": "auto"}),
        ((), "require", "PASS", {"mcu.link_check": "require"}),
        (("no_sample",), "auto", "PASS", {"mcu.link_check": "auto"}),
        (("plain_only",), "off", "SKIPPED", {}),
        (("no_check",), "auto", "SKIPPED", {}),
        (("comma_latched",), "require", "FAIL", {"mcu.link_check": "auto"}),
    ],
)
def test_the_check_is_used_where_it_is_known(
    faults: tuple[str, ...], wanted: str, verdict: str, keys: dict[str, object]
) -> None:
    with Robot(*faults, link_check=wanted).bench() as bench:
        finding = dialect.check(bench)
        assert (finding.verdict, finding.keys) == (verdict, keys)
        assert bench.sealed is (verdict == "PASS")
        assert bench.sampled is (not faults)
