"""Viewers may connect only from this machine."""

from __future__ import annotations

import pytest

from acsard.cli import foxglove as verb
from acsard.foxglove.address import DEFAULT, loopback
from acsard.host.errors import UsageError
from tests.each import each


@pytest.mark.parametrize(
    ("text", "address"),
    [
        (DEFAULT, ("127.0.0.1", 8765)),
        ("localhost:9000", ("127.0.0.1", 9000)),
        ("127.1.2.3:1", ("127.1.2.3", 1)),
    ],
)
def test_an_address_of_this_machine_is_taken(text: str, address: tuple[str, int]) -> None:
    assert loopback(text) == address


@pytest.mark.parametrize("text", ["0.0.0.0:8765", "192.168.1.5:8765", "8.8.8.8:80"])
def test_beyond_this_machine_is_refused_with_the_reason_and_the_tunnel(text: str) -> None:
    with pytest.raises(UsageError, match=r"asks nobody who he is.*ssh -N -L \d+:127\.0\.0\.1:\d+"):
        loopback(text)


@each("text", ["", "8765", "127.0.0.1", "robot:8765", "127.0.0.1:x", "[::1]:8765"])
def test_what_is_no_address_is_told_how_to_write_one(text: str) -> None:
    with pytest.raises(UsageError, match=r"write it like 127\.0\.0\.1:8765"):
        loopback(text)


@pytest.mark.parametrize("port", [0, 65536, -1])
def test_a_port_has_its_range(port: int) -> None:
    with pytest.raises(UsageError, match="from 1 to 65535"):
        loopback(f"127.0.0.1:{port}")


def test_the_help_names_the_default_that_there_is() -> None:
    assert verb.DEFAULT == DEFAULT
