"""Tests of the errors that `acsard foxglove` reports before it connects.

They concern its library and its address.
"""

from __future__ import annotations

import argparse
import sys

import pytest

from acsard.cli import foxglove
from acsard.host.errors import Exit, MendableError


def test_without_its_library_it_says_which_extra_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [name for name in sys.modules if name.startswith("acsard.foxglove")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "foxglove", None)  # as if the library were not installed
    with pytest.raises(MendableError, match=r"pipx? install .*\[foxglove(,tools)?\]'") as error:
        foxglove.main(argparse.Namespace())
    assert error.value.code == Exit.FAILURE


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
