"""Tests of the router configurations that `acsard router` accepts.

All others get an error.
"""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from acsard.door.fleet_router import Router
from acsard.host.errors import InUseError, RouterFileError

ROUTER_FILE = Path(__file__).resolve().parents[3] / "deploy" / "zenoh" / "router.json5"


def written(where: Path, text: str) -> Path:
    file = where / "router.json5"
    file.write_text(text)
    return file


def test_it_takes_the_fleets_file_as_it_is() -> None:
    router = Router(ROUTER_FILE)
    assert (router.where, router.most) == ("tls/0.0.0.0:7447", 256)
    assert router.ready()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{ mode: "peer", listen: { endpoints: ["tcp/127.0.0.1:0"] } }', "not a router's"),
        ('{ mode: "router", listen: { endpoints: [] } }', "not a router's"),
        # Zenoh would listen on every address without encryption
        ('{ mode: "router" }', "needs mode"),
        ('{ mode: "ruter" }', "; correct it"),
        ("", "router.json5"),
    ],
)
def test_what_is_none_is_refused_with_the_file_and_the_mend(
    tmp_path: Path, text: str, says: str
) -> None:
    with pytest.raises(RouterFileError) as error:
        Router(written(tmp_path, text))
    assert says in str(error.value)
    assert "router.json5" in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{ mode", "line 1, column 1: expected array, boolean, null, number, object, or string"),
        ('{\n  mode: "router"\n  listen: {} }', "line 2, column 9: expected boolean or null"),
        ('{ mode: "ruter" }', "line 1, column 9: unknown variant `ruter`, expected one of"),
        ("{\n  foo: 1 }", "line 2, column 3: unknown field `foo`"),
        ("{\n  foo: 1 }", "`plugins_loading`, `plugins`"),  # the last of 23 names
        ('{ mode: "a\\"b" }', 'unknown variant `a"b`'),
    ],
)
def test_what_cannot_be_read_is_told_whole_with_its_line_and_column(
    tmp_path: Path, text: str, says: str
) -> None:
    with pytest.raises(RouterFileError) as error:
        Router(written(tmp_path, text))
    assert says in str(error.value)
    assert ".rs" not in str(error.value)
    assert "Location" not in str(error.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(RouterFileError, match=r"nowhere\.json5"):
        Router(tmp_path / "nowhere.json5")


def on(where: Path, endpoint: str) -> Router:
    alone = "scouting: { multicast: { enabled: false } }"
    text = f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }}, {alone} }}'
    return Router(written(where, text))


def test_an_address_that_is_taken_may_be_free_later(tmp_path: Path) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as other,
        pytest.raises(InUseError, match="are the addresses free"),
    ):
        on(tmp_path, f"tcp/127.0.0.1:{other.getsockname()[1]}").open()


@pytest.mark.parametrize(
    ("endpoint", "says"),
    [("tls/127.0.0.1:0", "TLS private key"), ("pigeon/127.0.0.1:0", "pigeon protocol")],
)
def test_what_no_address_would_mend_is_the_file_s_fault(
    tmp_path: Path, endpoint: str, says: str
) -> None:
    with pytest.raises(RouterFileError, match=rf"router\.json5 cannot be used: .*{says}"):
        on(tmp_path, endpoint).open()
