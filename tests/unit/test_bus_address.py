"""Tests of how a program chooses its robot.

The program's arguments have precedence over the file that ACSARD_CONFIG names.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.bus.address import Address, address_by_environment
from acsard.client import connect
from acsard.host.errors import UnreachableError, UsageError

HERE = Address("tcp/127.0.0.1:7448", "acsar", "")

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
    file = tmp_path / "mine.toml"
    file.write_text(FILE)
    monkeypatch.setenv("ACSARD_CONFIG", str(file))
    monkeypatch.delenv("ACSARD_TLS", raising=False)
    return file


def test_without_the_variable_the_address_is_the_default_and_no_file_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ACSARD_CONFIG", raising=False)
    monkeypatch.delenv("ACSARD_TLS", raising=False)
    (tmp_path / "acsard.toml").write_text(FILE)
    monkeypatch.chdir(tmp_path)
    assert address_by_environment(None, None, None) == HERE


@pytest.mark.usefixtures("named")
def test_values_without_an_argument_come_from_the_file() -> None:
    tls = "tls/robot:7449"
    assert address_by_environment(None, None, None)[:3] == (NOBODY, "r7", "")
    assert address_by_environment(tls, None, None)[:3] == (tls, "r7", "/etc/acsard/tls")
    assert address_by_environment(None, "r8", None)[:3] == (NOBODY, "r8", "")
    assert address_by_environment(tls, "r8", "/home/a")[:3] == (tls, "r8", "/home/a")
    # an empty endpoint is refused later, as empty
    assert address_by_environment("", None, None).endpoint == ""


@pytest.mark.usefixtures("named")
def test_the_certificate_directory_of_the_environment_wins_over_the_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ACSARD_TLS", "/run/credentials")
    assert address_by_environment("tls/robot:7449", "r8", None).tls == "/run/credentials"


@pytest.mark.usefixtures("named")
def test_the_client_connects_to_the_endpoint_of_the_file() -> None:
    with pytest.raises(UnreachableError, match=NOBODY), connect():
        pass


@pytest.mark.parametrize(
    ("text", "words"), [(None, "No such file"), ("[robot]\nidd = 1\n", "did you mean id?")]
)
def test_a_file_that_cannot_be_used_is_an_error_that_names_it(
    named: Path, text: str | None, words: str
) -> None:
    if text is None:
        named.unlink()
    else:
        named.write_text(text)
    with pytest.raises(UsageError, match="which ACSARD_CONFIG names") as error:
        address_by_environment(None, "r8", "")
    assert words in str(error.value)
    assert str(named) in str(error.value)
    # A program that gives endpoint, robot id and certificate itself needs no file.
    assert address_by_environment(NOBODY, "r8", "")[:3] == (NOBODY, "r8", "")
