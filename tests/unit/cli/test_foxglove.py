"""Tests of the errors that `acsard foxglove` reports before it connects.

They concern its library and its address.
"""

from __future__ import annotations

import argparse
import sys

import pytest

from acsard.cli import foxglove
from acsard.host.errors import Exit, MendableError, UsageError
from tests.each import each


def test_without_its_library_it_says_which_extra_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [name for name in sys.modules if name.startswith("acsard.foxglove")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "foxglove", None)  # as if the library were not installed
    with pytest.raises(MendableError, match=r"pip install .*\[foxglove\]'") as error:
        foxglove.main(argparse.Namespace())
    assert error.value.code == Exit.FAILURE


def test_the_server_refuses_to_listen_beyond_this_machine() -> None:
    with pytest.raises(UsageError, match="has no authentication"):
        foxglove.main(argparse.Namespace(address="0.0.0.0:8765"))


# the address: viewers may connect only from this machine


@pytest.mark.parametrize(
    ("text", "address"),
    [
        (foxglove.DEFAULT_ADDRESS, ("127.0.0.1", 8765)),
        ("localhost:9000", ("127.0.0.1", 9000)),
        ("127.1.2.3:1", ("127.1.2.3", 1)),
    ],
)
def test_an_address_of_this_machine_is_taken(text: str, address: tuple[str, int]) -> None:
    assert foxglove.loopback(text) == address


@pytest.mark.parametrize("text", ["0.0.0.0:8765", "192.168.1.5:8765", "8.8.8.8:80"])
def test_an_address_beyond_this_machine_is_refused_and_the_message_names_a_tunnel(
    text: str,
) -> None:
    port = text.rpartition(":")[2]
    with pytest.raises(UsageError, match="has no authentication") as refused:
        foxglove.loopback(text)
    error = str(refused.value)
    assert "every client that connects could stop the robot" in error
    assert f"Listen on 127.0.0.1:{port} and" in error
    assert f"ssh -N -L {port}:127.0.0.1:{port} USER@ROBOT" in error


@each("text", ["", "8765", "127.0.0.1", "robot:8765", "127.0.0.1:x", "[::1]:8765"])
def test_an_invalid_address_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match=r"write it like 127\.0\.0\.1:8765"):
        foxglove.loopback(text)


@pytest.mark.parametrize("port", [0, 65536, -1])
def test_a_port_has_its_range(port: int) -> None:
    with pytest.raises(UsageError, match="from 1 to 65535"):
        foxglove.loopback(f"127.0.0.1:{port}")
