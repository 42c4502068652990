"""Tests of the reasons for a silent key, as far as this computer can find them."""

from __future__ import annotations

from acsard.core.messages.topics import PUBLISHED
from acsard.daemon.bus.silent_key import MAX_NAMED, Presence, explain_silence
from tests.each import each

HERE, PLAIN, TLS = Presence(linked=True, here=True), "tcp/127.0.0.1:7448", "tls/router:7447"


def absent(*others: str) -> Presence:
    return Presence(True, False, others)


def test_for_an_absent_robot_the_most_similar_id_comes_first() -> None:
    told = explain_silence("state", "rob1t1", PLAIN, absent("acsar", "robot2", "robot1"))
    assert (
        "there is no robot rob1t1, but there is robot1, robot2, acsar: choose one, --id robot1"
        in told
    )


def test_only_a_few_robots_of_a_large_fleet_are_named() -> None:
    told = explain_silence("state", "robot7", PLAIN, absent(*(f"robot{n:02}" for n in range(100))))
    assert (
        told.count("robot") == 2 + MAX_NAMED + 1
    )  # "no robot robot7", the listed robots, and "--id"
    assert f"and {100 - MAX_NAMED} more (`acsard fleet`)" in told


def test_if_no_robot_is_visible_the_message_names_the_endpoint() -> None:
    assert f"no robot is visible at {PLAIN}" in explain_silence("state", "acsar", PLAIN, absent())
    assert "`acsard whoami --id robot1`" in explain_silence("state", "robot1", TLS, absent())


def test_a_lost_connection_is_reported_before_all_other_reasons() -> None:
    told = explain_silence("oddom", "acsar", PLAIN, Presence(linked=False, here=False))
    assert f"{PLAIN} has no connection any more" in told


@each(
    ("key", "words"),
    [
        ("oddom", "did you mean odom?"),
        ("cmd/app", "no program sends on cmd/app now"),
        ("imu", "no program sends on imu now"),
        ("sim/pose", "only the simulator publishes sim/pose"),
        ("json/sim/pose", "only the simulator"),
        ("events", "`acsard get events` prints its last value"),
        ("odom", "is published only with answers of the microcontroller"),
        ("json/tf", "is published only with answers of the microcontroller"),
        ("diagnostics", "may you follow it"),
    ],
)
def test_for_a_present_robot_the_reason_is_about_the_key(key: str, words: str) -> None:
    told = explain_silence(key, "acsar", PLAIN, HERE)
    assert told.startswith("robot acsar is there, but ")
    assert words in told


@each("key", [one.key for one in PUBLISHED])
def test_each_published_key_has_a_reason(key: str) -> None:
    assert "no such key" not in explain_silence(key, "acsar", PLAIN, HERE)
