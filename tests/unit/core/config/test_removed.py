"""Tests of the settings that no longer exist."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.cli.common import load
from acsard.core.config.live import changed
from acsard.core.config.parsing import ConfigError
from acsard.core.config.removed import REMOVED
from acsard.core.config.settings import Config
from acsard.host.errors import MendableError
from tests.each import each
from tests.unit.keys import KEYS


@each("key", REMOVED)
def test_a_removed_setting_is_refused_with_what_to_do(
    key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not any(known.path == key or known.path.startswith(f"{key}.") for known in KEYS)
    table, _, name = key.rpartition(".")
    advice = f"this setting no longer exists; {REMOVED[key]}"
    file = tmp_path / "acsard.toml"
    file.write_text(f"[{table}]\n{name} = 1\n" if table else f"[{key}]\npublish_tf = 1\n")
    with pytest.raises(MendableError):
        load(str(file))
    value = "1" if table else "{publish_tf = 1}"
    assert capsys.readouterr().err == f"{file}: {key} = {value}: {advice}\n"
    setting = key if table else f"{key}.publish_tf"
    with pytest.raises(ConfigError) as at_runtime:
        changed(Config(), {setting: 1}, at_rest=True)
    assert at_runtime.value.problems == [f"{setting} = 1: {advice}"]
