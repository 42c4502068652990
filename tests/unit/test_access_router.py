"""A file that is not a router's configuration is refused with its name and the fix."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.bus.fleet_router import open_router
from acsard.host.errors import RouterFileError


def written(where: Path, text: str) -> Path:
    file = where / "router.json5"
    file.write_text(text)
    return file


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        (
            '{ mode: "peer", listen: { endpoints: ["tcp/127.0.0.1:0"] } }',
            "not the configuration of a router",
        ),
        ('{ mode: "router", listen: { endpoints: [] } }', "not the configuration of a router"),
        # Zenoh would listen on every address without encryption
        ('{ mode: "router" }', "needs mode"),
        ('{ mode: "ruter" }', "; correct it"),
        ("", "router.json5"),
    ],
)
def test_a_file_that_is_not_for_a_router_is_refused_with_its_name_and_the_fix(
    tmp_path: Path, text: str, phrase: str
) -> None:
    with pytest.raises(RouterFileError) as error:
        open_router(written(tmp_path, text))
    assert phrase in str(error.value)
    assert "router.json5" in str(error.value)


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("{ mode", "line 1, column 1: expected array, boolean, null, number, object, or string"),
        ('{\n  mode: "router"\n  listen: {} }', "line 2, column 9: expected boolean or null"),
        ('{ mode: "ruter" }', "line 1, column 9: unknown variant `ruter`, expected one of"),
        ("{\n  foo: 1 }", "line 2, column 3: unknown field `foo`"),
        ("{\n  foo: 1 }", "`plugins_loading`, `plugins`"),  # the last of 23 names
        ('{ mode: "a\\"b" }', 'unknown variant `a"b`'),
    ],
)
def test_a_mistake_in_the_file_is_reported_with_line_and_column(
    tmp_path: Path, text: str, phrase: str
) -> None:
    with pytest.raises(RouterFileError) as error:
        open_router(written(tmp_path, text))
    assert phrase in str(error.value)
    assert ".rs" not in str(error.value)
    assert "Location" not in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RouterFileError, match=r"nowhere\.json5"):
        open_router(tmp_path / "nowhere.json5")
