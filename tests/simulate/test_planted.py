"""Checks that each fault can be planted into the product, and that the simulator finds it."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import acsard
from tests.simulate import planted
from tests.simulate.planted import (
    CASE_MINUTES,
    FAULT_MINUTES,
    MEASURED_WITH,
    TABLE,
    Play,
    Row,
    edited,
    read,
    text_of,
)
from tests.simulate.planted_cases import CASES
from tests.simulate.planted_faults import FAULTS, PLANS_OF_FAULT, Fault

ALL = (*FAULTS, *CASES)
PACKAGE = Path(acsard.__file__).parent


@pytest.mark.parametrize("fault", ALL, ids=lambda fault: fault.name)
def test_a_fault_fits_the_product_and_is_still_a_program(fault: Fault) -> None:
    for text in edited(fault).values():
        ast.parse(text)


def test_faults_use_only_names_that_exist(tmp_path: Path) -> None:
    """Otherwise each seed finds the fault, because the planted product raises `NameError`."""
    for fault in ALL:
        for module, text in edited(fault).items():
            path = tmp_path / fault.name / module
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    ruff = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F821", str(tmp_path)]
    checked = subprocess.run(ruff, capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stdout


def test_faults_use_only_attributes_that_exist() -> None:
    """Otherwise each seed finds the fault, because the planted product raises `AttributeError`."""
    product = " ".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    names = set(re.findall(r"\w+", product))
    for fault in ALL:
        planted_text = " ".join(edit.new for edit in fault.edits)
        declared = set(re.findall(r"\b(_\w+):", planted_text))
        assert set(re.findall(r"\.(_[a-z]\w*)", planted_text)) <= names | declared, fault.name


def test_plans_are_chosen_for_faults_that_exist() -> None:
    names = {fault.name for fault in ALL}
    assert names | {name.split()[0] for name in names} >= PLANS_OF_FAULT.keys()


def test_each_fault_has_a_name_of_its_own() -> None:
    assert len(ALL) == len({fault.name for fault in ALL})


@pytest.mark.parametrize(("faults", "minutes"), [(FAULTS, FAULT_MINUTES), (CASES, CASE_MINUTES)])
def test_the_table_says_that_each_fault_was_found_in_time(
    faults: tuple[Fault, ...], minutes: float
) -> None:
    rows = read()
    assert [f.name for f in faults if f.name not in rows or not rows[f.name].seed] == []
    assert [f.name for f in faults if rows[f.name].breaks != f.breaks] == []
    assert [f.name for f in faults if float(rows[f.name].core) > minutes] == []


def test_the_page_is_the_one_that_the_program_writes() -> None:
    assert TABLE.read_text(encoding="utf-8") == text_of(read())


def test_the_table_has_no_fault_that_is_not_planted_any_more() -> None:
    assert read().keys() <= {"name", *(fault.name for fault in ALL)}


@pytest.mark.slow
def test_a_fault_of_the_first_line_is_found_in_a_copy_of_the_product() -> None:
    fault = next(fault for fault in FAULTS if fault.name == "codec zeros")
    assert planted.hunt(fault, 0.1).promise == "every line is whole"


def test_a_change_of_a_judge_changes_the_version() -> None:
    """Each module of the simulator is hashed, unless it cannot change the finding of a seed."""
    beside = {"__init__", "__main__", "differences", "pairs", "shrink", "unjudged"}
    planting = {"planted", "planted_cases", "planted_faults"}
    modules = {path.stem for path in TABLE.parent.glob("*.py")}
    tests = {name for name in modules if name.startswith("test_")}
    assert modules - beside - planting - tests == set(MEASURED_WITH)


def test_a_row_whose_seed_finds_nothing_any_more_is_listed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, third = FAULTS[:3]
    row = Row("", "", "a promise", "7", "0.1", "1.0", "abcdef")
    rows = {first.name: row, second.name: row._replace(seed="8"), third.name: row._replace(seed="")}
    monkeypatch.setattr(planted, "read", lambda: rows)
    monkeypatch.setattr(planted, "plant", lambda fault, tree: None)
    monkeypatch.setattr(planted, "sound_finding", lambda seed: "")
    monkeypatch.setattr(
        planted,
        "plays",
        lambda tree, first, seconds: [Play(first[0], "so" * (first == [7]), 1.0, 9.0)],
    )
    assert planted.again(list(FAULTS), 1) == 1
    out = capsys.readouterr().out
    assert f"{second.name}: seed 8 of version abcdef breaks no promise\n1 of 2 rows hold" in out
