"""Tests of the errors that prevent a connection. The client exports all of them."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

import pytest

from acsard import client

NOBODY_LISTENS = "tls/127.0.0.1:1"


@pytest.fixture
def shared() -> Iterator[Path]:
    """Yield a directory that every user may enter, even when `tmp_path` is inside a private one."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


AS_NOBODY = """\
import os, sys
from acsard.client import connect
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
try:
    with connect(sys.argv[1], tls=sys.argv[2]):
        pass
except PermissionError as error:
    print(error)
"""


def test_certificates_without_read_permission_raise_a_permission_error(shared: Path) -> None:
    for name in ("ca.pem", "certificate.pem", "key.pem"):
        (shared / name).write_text("of somebody else")
        (shared / name).chmod(0o600 if os.geteuid() == 0 else 0)
    words = [sys.executable, "-c", AS_NOBODY, NOBODY_LISTENS, str(shared)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30.0, check=True)
    assert str(shared / "ca.pem") in done.stdout


def test_a_directory_without_certificates_is_reported_and_not_taken_for_a_missing_daemon(
    tmp_path: Path,
) -> None:
    with (
        pytest.raises(client.CertificateError, match="acsard tls") as error,
        client.connect(NOBODY_LISTENS, tls=str(tmp_path / "laptop-anna")),
    ):
        pass
    assert isinstance(error.value, ValueError)


def test_every_documented_error_is_exported_by_the_client() -> None:
    assert client.__doc__ is not None
    names = {line.split()[0] for line in client.__doc__.splitlines() if line.startswith("    ")}
    errors = {name for name in names if name.endswith("Error")}
    assert errors == {n for n in client.__all__ if n.endswith("Error")} - {"AcsardError"}
    assert all(issubclass(getattr(client, name), client.AcsardError) for name in errors)


def test_a_missing_daemon_is_reported_without_the_errors_of_zenoh() -> None:
    with pytest.raises(client.UnreachableError) as raised, client.connect("tcp/127.0.0.1:1"):
        pass
    trace = "".join(traceback.format_exception(raised.value))
    assert "no daemon answers at tcp/127.0.0.1:1" in trace
    assert "ZError" not in trace
    assert ".rs" not in trace
