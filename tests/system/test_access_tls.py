"""What Zenoh does with certificates and keys, which decides what a tool says of them.

`unit/test_access_tls.py` has the trouble of each wrong certificate.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest
import zenoh
from cryptography.hazmat.primitives.asymmetric import ec
from msgspec.structs import replace

from acsard.bus.tls_trouble import trouble
from acsard.bus.zenoh_sessions import client_session, daemon_session
from acsard.core.config.settings import BusConfig, Config
from acsard.host.errors import CertificateError, MendableError
from acsard.machine.authority import Authority
from tests.system.harness import free_endpoint
from tests.system.identities import free_tls_endpoint

ALL_NAMES = ["localhost", "127.0.0.1"]


@pytest.fixture(scope="module", name="tls")
def _tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide certificates: good ones, some of an expired authority, and one that Zenoh refuses."""
    place = tmp_path_factory.mktemp("tls")
    ours = Authority.make(place / "ca", "ours", 10, ["robot.example"])
    ours.issue(place / "client", "client", [], 1)
    ours.issue(place / "robot", "robot", ALL_NAMES, 1)
    # OpenSSL accepts a key of this curve, and Zenoh does not.
    with mock.patch.object(ec, "SECP256R1", ec.SECP521R1):
        ours.issue(place / "P-521", "client", [], 1)
    old = Authority.make(place / "old ca", "old", -1)
    old.issue(place / "old client", "client", [], 1)
    old.issue(place / "old robot", "robot", ALL_NAMES, 1)
    return place


def listening(own: Path, endpoint: str) -> zenoh.Session:
    settings = zenoh.Config()
    settings.insert_json5("listen/endpoints", json.dumps([endpoint]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    tls = {
        "root_ca_certificate": str(own / "ca.pem"),
        "listen_certificate": str(own / "certificate.pem"),
        "listen_private_key": str(own / "key.pem"),
        "enable_mtls": True,
    }
    settings.insert_json5("transport/link/tls", json.dumps(tls))
    return zenoh.open(settings)


@pytest.fixture(scope="module", name="robot")
def _robot(tls: Path) -> Iterator[str]:
    """Run a listener with a valid certificate."""
    endpoint = free_tls_endpoint()
    with listening(tls / "robot", endpoint):
        yield endpoint


def connection_error(endpoint: str, directory: str) -> MendableError:
    with pytest.raises(MendableError) as error:
        client_session(endpoint, directory)
    return error.value


def test_connecting_without_a_certificate_directory_asks_for_the_option_tls() -> None:
    error = connection_error("tls/no.such.host.invalid:7449", "")
    assert isinstance(error, CertificateError)
    assert "--tls DIRECTORY" in str(error)


def test_the_certificate_directory_is_checked_before_the_network(tmp_path: Path) -> None:
    error = connection_error("tls/no.such.host.invalid:7449", str(tmp_path / "none"))
    assert isinstance(error, CertificateError)
    assert f"there is no directory {tmp_path / 'none'}" in str(error)


def test_zenoh_ignores_that_the_authority_has_expired_so_no_trouble_is_reported(tls: Path) -> None:
    endpoint = free_tls_endpoint()
    with listening(tls / "old robot", endpoint):
        client_session(endpoint, str(tls / "old client")).close()
        assert trouble(endpoint, str(tls / "old client")) is None


def test_a_tool_with_a_key_that_zenoh_refuses_names_the_key(tls: Path, robot: str) -> None:
    error = connection_error(robot, str(tls / "P-521"))
    assert isinstance(error, CertificateError)
    assert f"the key {tls / 'P-521' / 'key.pem'} cannot be used" in str(error)
    assert "(failed to parse private key" in str(error)


def test_a_daemon_with_a_key_that_zenoh_refuses_names_the_key_instead_of_waiting_for_its_router(
    tls: Path, robot: str
) -> None:
    bus = BusConfig(listen=(free_endpoint(),), connect=(robot,), tls=str(tls / "P-521"))
    with pytest.raises(CertificateError, match=r"the key \S*P-521/key\.pem cannot be used"):
        daemon_session(replace(Config(), bus=bus)).close()


def test_the_error_names_a_host_that_does_not_resolve(tls: Path) -> None:
    error = connection_error("tls/no.such.host.invalid:7449", str(tls / "client"))
    assert "the name no.such.host.invalid does not resolve" in str(error)
