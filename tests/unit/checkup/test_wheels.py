"""Tests of the findings about motor and encoder channels: pure functions of the observations."""

from __future__ import annotations

import pytest
from msgspec import structs

from acsard.checkup.wheels import Channel, Kind, encoder_finding, wheel_map
from acsard.config.settings import McuConfig, WheelMap
from acsard.mcu.codec import Motors
from acsard.values import WHEELS

MCU = McuConfig()


def seen(motor: int, encoder: int, forth: float = 3.0, back: float = -3.0) -> Channel:
    def speeds(value: float) -> Motors:
        a, b, c, d = (value if index == encoder else 0.0 for index in range(4))
        return a, b, c, d

    return Channel(motor, speeds(forth), speeds(back))


@pytest.mark.parametrize(
    ("channel", "kind"),
    [
        (seen(0, 0), "right"),
        (seen(0, 0, 3.1, -2.9), "right"),
        (seen(0, 0, 3.7, -2.3), "off"),
        (seen(0, 0, 2.4, -2.4), "off"),
        (seen(0, 0, 2.9, -3.2), "off"),
        (seen(0, 0, 4.0, -3.0), "size"),
        (seen(0, 0, 2.0, -2.0), "size"),
        (seen(0, 0, -3.0, 3.0), "reversed"),
        (seen(0, 0, 3.0, 3.0), "size"),
        (seen(0, 0, 0.0, 0.0), "dead"),
        (seen(0, 0, 3.0, 0.0), "one way"),
        (seen(0, 2), "other"),
        (seen(0, 2, -3.0, 3.0), "other"),
        (Channel(1, (3.0, 3.0, 0.0, 0.0), (-3.0, -3.0, 0.0, 0.0)), "several"),
        (Channel(1, (3.0, 0.0, 0.0, 0.0), (0.0, -3.0, 0.0, 0.0)), "several"),
    ],
)
def test_what_the_encoders_say(channel: Channel, kind: Kind) -> None:
    assert channel.kind == kind
    finding = encoder_finding(MCU, channel)
    assert finding.verdict == {"right": "PASS", "off": "WARN"}.get(kind, "FAIL")
    assert bool(finding.mend) is (kind != "right")


def test_an_other_encoder_that_counts_back_is_said_to_be_reversed_too() -> None:
    assert "reversed" in encoder_finding(MCU, seen(0, 1, -3.0, 3.0)).text
    assert "reversed" not in encoder_finding(MCU, seen(0, 1)).text


def test_names_are_those_of_the_configured_wheels() -> None:
    mcu = McuConfig(wheels=WheelMap("-d", "+b", "+c", "+a"))
    assert encoder_finding(mcu, seen(0, 0)).name == "motor a (rear right)"
    assert encoder_finding(mcu, seen(3, 3)).name == "motor d (front right)"


def test_a_map_needs_a_person_for_every_motor() -> None:
    channels = [Channel(m, seen(m, m).forth, seen(m, m).back, WHEELS[m]) for m in range(4)]
    assert wheel_map(MCU, channels).verdict == "PASS"
    assert wheel_map(MCU, [*channels[:3], seen(3, 3)]).verdict == "SKIPPED"


def test_a_wheel_seen_twice_is_no_map() -> None:
    channels = [Channel(m, seen(m, m).forth, seen(m, m).back, WHEELS[min(m, 2)]) for m in range(4)]
    finding = wheel_map(MCU, channels)
    assert (finding.verdict, finding.keys) == ("FAIL", {})
    assert "rear left" in finding.text


def test_a_motor_a_fifth_weak_is_told_with_its_share() -> None:
    finding = encoder_finding(MCU, seen(2, 2, 2.4, -2.45))
    assert "20% slower than the 3 rad/s" in finding.text
    assert "faster" in encoder_finding(MCU, seen(2, 2, 3.3, -3.3)).text
    assert "turn freely" in finding.mend


def test_what_counts_of_a_coarse_encoder_leave_open_is_not_blamed_on_the_motor() -> None:
    channel = seen(0, 0, 3.0, -2.75)
    assert channel.kind == "off"
    assert structs.replace(channel, unsure=0.05).kind == "right"
