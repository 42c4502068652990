"""A test that is deleted is a loss against the baseline, unless its code was deleted too."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
DOOR = "def is_open(angle: float) -> bool:\n    return abs(angle) > 5.0\n"
TESTS = """from acsard.door import is_open

def test_a_door_opens_in_both_directions():
    assert is_open(6.0) and is_open(-6.0)

def test_a_door_is_closed_up_to_its_limit():
    assert not is_open(5.0)
"""


@pytest.mark.slow
def test_a_test_that_is_deleted_is_a_loss(tmp_path: Path) -> None:
    def power(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "tests.power", *words, "--scales", "mutants"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    shutil.copytree(HERE, tmp_path / "tests/power", ignore=shutil.ignore_patterns("*.json"))
    for name in ("pyproject.toml", "tests/__init__.py", "tests/conftest.py", "tests/each.py"):
        shutil.copy(HERE.parents[1] / name, tmp_path / name)
    product, tests = tmp_path / "acsard/door.py", tmp_path / "tests/unit/test_door.py"
    for path, text in ((product, DOOR), (tests, TESTS)):
        path.parent.mkdir()
        (path.parent / "__init__.py").touch()
        path.write_text(text)
    measured = power("baseline")
    assert "mutants: 6, measured 6, noticed 6" in measured.stdout, measured

    tests.write_text(TESTS.partition("def test_a_door_is_closed")[0])
    lost = power("compare")
    assert lost.returncode == 1, lost
    assert "LOST mutants: acsard/door.py is_open: 'return abs(angle) > 5.0'" in lost.stdout

    product.write_text("")
    gone = power("compare")
    assert gone.returncode == 0, gone
    assert "gone mutants: 6 with code of acsard/door.py" in gone.stdout
