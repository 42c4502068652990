"""Generated files and parts of files follow their tables, and a release has its public names."""

from __future__ import annotations

import pytest

from tests.tools.tables import FILES, ROOT


@pytest.mark.parametrize("name", FILES)
def test_each_file_is_what_its_tables_say(name: str) -> None:
    """`python -m tests.tools.tables` writes the files again."""
    assert (ROOT / name).exists(), "type python -m tests.tools.tables"
    text = (ROOT / name).read_text()
    assert FILES[name](text) == text, f"`python -m tests.tools.tables` writes {name} again"
