"""Tests of the sentence for each way in which a TLS connection fails."""

from __future__ import annotations

import errno
import os
import socket
from typing import Any

import pytest

from acsard.bus.tls_trouble import trouble


@pytest.mark.parametrize(
    ("number", "told", "untold"),
    [
        (errno.EHOSTUNREACH, "robot.local is not there (No route to host)", "listens"),
        (errno.ENETUNREACH, "robot.local is not there (Network is unreachable)", "listens"),
        (errno.ECONNREFUSED, "nobody listens on port 7449 of robot.local", "not there"),
    ],
)
def test_a_host_that_is_not_there_is_not_one_on_which_nobody_listens(
    number: int, told: str, untold: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connection(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(socket, "create_connection", connection)
    found = trouble("tls/robot.local:7449", "")
    assert told in found
    assert untold not in found


@pytest.mark.parametrize("options", ["?prio=0-5", "#iface=eth0", "?prio=0-5#iface=eth0"])
def test_the_options_of_an_endpoint_are_not_part_of_its_port(
    options: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def connection(address: tuple[str, int], *_: Any) -> None:
        asked.append(address)
        raise TimeoutError

    monkeypatch.setattr(socket, "create_connection", connection)
    assert trouble(f"tls/robot.local:7449{options}", "") == (
        "robot.local is silent on port 7449: is it on, and does a firewall drop connections?"
    )
    assert asked == [("robot.local", 7449)]
