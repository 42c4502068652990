"""Tests of the reasons for a silent key, as far as this computer can find them."""

from __future__ import annotations

from acsard.core.messages.topics import PUBLISHED
from acsard.daemon.bus.silent_key import MAX_NAMED, Presence, explain_silence
from tests.each import each

HERE, PLAIN, TLS = Presence(linked=True, here=True), "tcp/127.0.0.1:7448", "tls/router:7447"


def absent(*others: str) -> Presence:
    return Presence(True, False, others)


def test_of_a_robot_that_is_not_there_the_one_most_like_it_is_told_first() -> None:
    told = explain_silence("state", "rob1t1", PLAIN, absent("acsar", "robot2", "robot1"))
    assert (
        "there is no robot rob1t1, but there is robot1, robot2, acsar: choose one, --id robot1"
        in told
    )


def test_of_a_large_fleet_a_few_are_told() -> None:
    told = explain_silence("state", "robot7", PLAIN, absent(*(f"robot{n:02}" for n in range(100))))
    assert (
        told.count("robot") == 2 + MAX_NAMED + 1
    )  # "no robot robot7", the listed robots, and "--id"
    assert f"and {100 - MAX_NAMED} more (`acsard fleet`)" in told


def test_where_nobody_is_seen_the_place_is_told() -> None:
    assert f"no robot is visible at {PLAIN}" in explain_silence("state", "acsar", PLAIN, absent())
    assert "`acsard whoami --id robot1`" in explain_silence("state", "robot1", TLS, absent())


def test_a_daemon_that_is_gone_is_told_before_all_else() -> None:
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
def test_of_a_robot_that_is_there_the_key_is_told(key: str, words: str) -> None:
    told = explain_silence(key, "acsar", PLAIN, HERE)
    assert told.startswith("robot acsar is there, but ")
    assert words in told


@each("key", [one.key for one in PUBLISHED])
def test_each_published_key_has_a_reason(key: str) -> None:
    assert "no such key" not in explain_silence(key, "acsar", PLAIN, HERE)
