"""What `acsard router` takes for a router's configuration, and what it says of anything else."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.door.router import Router
from acsard.host.errors import UsageError

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
        ('{ mode: "router" }', "needs mode"),  # Zenoh would listen everywhere, in clear
        ('{ mode: "ruter" }', "ruter"),
        ("{ mode", "router.json5"),
        ("", "router.json5"),
    ],
)
def test_what_is_none_is_refused_with_the_file_and_the_mend(
    tmp_path: Path, text: str, says: str
) -> None:
    with pytest.raises(UsageError) as error:
        Router(written(tmp_path, text))
    assert says in str(error.value)
    assert "router.json5" in str(error.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nowhere\.json5"):
        Router(tmp_path / "nowhere.json5")
