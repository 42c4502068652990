"""How a program chooses its robot and its endpoint, and why a robot is silent."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.bus import zenoh_sessions
from acsard.bus.address import Address, address_by_environment
from acsard.bus.robot_discovery import (
    MAX_NAMED,
    Presence,
    explain_silence,
    no_robot_text,
    parse_ids,
    robot_of,
)
from acsard.bus.zenoh_sessions import daemon_session
from acsard.client import connect
from acsard.core.config.settings import BusConfig, Config
from acsard.host.errors import InUseError, MendableError, UnreachableError, UsageError
from tests.each import each

NOBODY = "tcp/127.0.0.1:1"
"""An endpoint on which no router listens."""

FILE = f"""
[robot]
id = "r7"
[bus]
listen = ["{NOBODY}"]
tls = "/etc/acsard/tls"
"""


@pytest.fixture(name="named")
def _named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a configuration file and point ACSARD_CONFIG at it."""
    file = tmp_path / "acsard.toml"
    file.write_text(FILE)
    monkeypatch.setenv("ACSARD_CONFIG", str(file))
    monkeypatch.delenv("ACSARD_TLS", raising=False)
    return file


def test_the_arguments_win_over_the_environment_and_over_the_file_that_it_names(
    named: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tls = "tls/robot:7449"
    assert address_by_environment(None, None, None)[:3] == (NOBODY, "r7", "")
    assert address_by_environment(tls, None, None)[:3] == (tls, "r7", "/etc/acsard/tls")
    assert address_by_environment(None, "r8", None)[:3] == (NOBODY, "r8", "")
    assert address_by_environment(tls, "r8", "/home/a")[:3] == (tls, "r8", "/home/a")
    # An empty endpoint is refused later, as empty.
    assert address_by_environment("", None, None).endpoint == ""
    with pytest.raises(UnreachableError, match=NOBODY), connect():
        pass
    monkeypatch.setenv("ACSARD_TLS", "/run/credentials")
    assert address_by_environment(tls, "r8", None).tls == "/run/credentials"
    # Without the variable, no file is read, not even one that is here.
    monkeypatch.delenv("ACSARD_TLS")
    monkeypatch.delenv("ACSARD_CONFIG")
    monkeypatch.chdir(named.parent)
    assert address_by_environment(None, None, None) == Address("tcp/127.0.0.1:7448", "acsar", "")


@pytest.mark.parametrize(
    ("text", "words"), [(None, "No such file"), ("[robot]\nidd = 1\n", "did you mean id?")]
)
def test_an_unusable_file_is_named(named: Path, text: str | None, words: str) -> None:
    if text is None:
        named.unlink()
    else:
        named.write_text(text)
    with pytest.raises(UsageError, match="which ACSARD_CONFIG names") as error:
        address_by_environment(None, "r8", "")
    assert words in str(error.value)
    assert str(named) in str(error.value)


def test_a_client_without_a_session_names_its_router_and_no_address_to_listen_on() -> None:
    with pytest.raises(MendableError) as caught:
        daemon_session(Config(bus=BusConfig(mode="client", connect=("nonsense",))))
    assert not isinstance(caught.value, InUseError)
    text = str(caught.value)
    assert text.startswith("cannot open the Zenoh session to nonsense: ")
    assert text.endswith("; check bus.connect, then start acsard again")
    assert "listen" not in text


def test_an_address_that_this_computer_does_not_have_is_waited_for_and_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """DHCP may bring it later; 192.0.2.7 is nobody's."""
    waits: list[float] = []
    monkeypatch.setattr("time.sleep", waits.append)
    monkeypatch.setattr(zenoh_sessions, "ADDRESS_WAIT_S", 0.3)
    bus = BusConfig(listen=("tcp/192.0.2.7:7448",), insecure=True)
    with pytest.raises(InUseError, match="this computer does not have one of these addresses"):
        daemon_session(Config(bus=bus))
    assert set(waits) == {zenoh_sessions.ADDRESS_RETRY_S}


# several robots


@each(
    ("text", "ids"),
    [("robot1", ()), ("*", ("*",)), ("robot1,robot2", ("robot1", "robot2")),
     ("b, a,b", ("b", "a")),
     *((text, None) for text in ("a,", ",", "a,*", "a,b/c", "a,$*"))],
)  # fmt: skip
def test_an_id_names_one_robot_several_or_all(text: str, ids: tuple[str, ...] | None) -> None:
    if ids is None:
        with pytest.raises(UsageError, match="comma"):
            parse_ids(text)
    else:
        assert parse_ids(text) == ids


@each(
    ("key", "robot"),
    [("acsard/robot1/state", "robot1"), ("acsard/robot1/srv/stop", "robot1"),
     ("acsard/*/state", ""), ("acsard/**", ""), ("acsard/robot1/**", ""), ("other/robot1/x", "")],
)  # fmt: skip
def test_a_key_belongs_to_one_robot_and_a_wildcard_to_none(key: str, robot: str) -> None:
    assert robot_of(key) == robot


# a robot that is silent

HERE, PLAIN, TLS = Presence(linked=True, here=True), "tcp/127.0.0.1:7448", "tls/router:7447"


def absent(*others: str) -> Presence:
    return Presence(True, False, others)


@each(
    ("key", "robot", "endpoint", "presence", "words"),
    [
        ("state", "rob1t1", PLAIN, absent("acsar", "robot2", "robot1"),
         "there is no robot rob1t1. Robots here: robot1, robot2, acsar; use --id robot1"),
        ("state", "robot7", PLAIN, absent(*(f"robot{n:02}" for n in range(100))),
         f"and {100 - MAX_NAMED} more"),
        ("state", "acsar", PLAIN, absent(), f"no robot is visible at {PLAIN}"),
        ("state", "robot1", TLS, absent(), "`acsard doctor --id robot1`"),
        ("oddom", "acsar", PLAIN, Presence(linked=False, here=False),
         f"the connection to {PLAIN} is lost"),
        *((key, "acsar", PLAIN, HERE, words) for key, words in (
            ("oddom", "did you mean odom?"),
            ("cmd/app", "no program sends on the Zenoh key cmd/app now"),
            ("imu", "no program sends on the Zenoh key imu now"),
            ("sim/pose", "only the simulator publishes sim/pose"),
            ("json/sim/pose", "only the simulator"),
            ("events", "`acsard get events` prints its last value"),
            ("odom", "is published only while the microcontroller answers"),
            ("json/tf", "is published only while the microcontroller answers"),
            ("battery", "only while the board reports the battery's voltage or charge"),
            ("diagnostics", "lacks the permission to read it"))),
    ],
)  # fmt: skip
def test_a_silence_is_explained(
    key: str, robot: str, endpoint: str, presence: Presence, words: str
) -> None:
    text = explain_silence(key, robot, endpoint, presence)
    assert words in text
    assert text.startswith("robot acsar is there, but ") == presence.here
    assert text.count("robot0") in (0, MAX_NAMED)


def test_over_tls_the_message_asks_for_the_names_of_the_robots() -> None:
    far, here = no_robot_text(TLS), no_robot_text(PLAIN)
    for words in ("name the robots", "`acsard doctor --id robot1` checks"):
        assert (words in far, words in here) == (True, False)
