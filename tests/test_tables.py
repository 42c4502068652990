"""The generated parts of the pages and of the deployment files follow the table of keys."""

from __future__ import annotations

import pytest

from tests.tools.tables import FILES, ROOT


@pytest.mark.parametrize("name", FILES)
def test_each_file_agrees_with_the_table_of_keys_and_roles(name: str) -> None:
    text = (ROOT / name).read_text()
    assert FILES[name](text) == text, f"`python -m tests.tools.tables` writes {name} again"
