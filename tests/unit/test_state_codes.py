"""Each code of the tables is used, each use has a row, and no other code is published."""

from __future__ import annotations

import ast
import re
import string
from collections.abc import Iterator
from pathlib import Path
from typing import cast, get_args

import pytest
from msgspec.structs import replace

import acsard
from acsard.checkup.outcomes import OUTCOMES_BY_CODE, Outcome
from acsard.core.codes import CODES, Code, StateCode, level_of, sentence
from acsard.core.messages.schema import DiagnosticStatus, KeyValue
from acsard.core.messages.state_warnings import warnings
from acsard.core.tables.finding_table import NO_TEXT, Entry, code_of
from acsard.core.tables.stop_codes import StopCode
from acsard.machine.examination import reported
from acsard.recording.file import SUFFIX, Recording
from tests import recordings
from tests.unit.screens import STATE

PACKAGE = Path(acsard.__file__).parent


def test_the_recordings_publish_only_codes_of_the_table() -> None:
    seen = set()
    for path in Path(recordings.__file__).parent.glob(f"*{SUFFIX}"):
        for step in Recording([path]).steps():
            code = step.recorded.status.code
            assert code in get_args(StateCode)
            seen.add(code)
            assert {event.code for event in step.recorded.events} <= {"", *CODES}
    assert len(seen) > 5


CALLS = ("reason", "sentence", "finding", "find")
TABLE = {**CODES, **OUTCOMES_BY_CODE}


def names_in(entry: Entry) -> set[str]:
    parts = " ".join((entry.figure, entry.text, entry.advice))
    return {name for _, name, _, _ in string.Formatter().parse(parts) if name}


@pytest.fixture(scope="module")
def nodes() -> list[ast.AST]:
    """Return the nodes of the package outside of the tables themselves."""
    tables = (PACKAGE / "core/tables", PACKAGE / "checkup/outcomes.py")
    return [
        node
        for path in PACKAGE.rglob("*.py")
        if not any(path.is_relative_to(table) for table in tables)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    ]


def literals(node: ast.expr) -> Iterator[str]:
    """Yield the texts that an expression may be, if they are literal."""
    match node:
        case ast.Constant(value=str(text)):
            yield text
        case ast.IfExp(body=body, orelse=orelse):
            yield from (*literals(body), *literals(orelse))


def test_each_name_of_a_code_has_an_entry_in_its_table_and_no_other_has() -> None:
    names = [*map(code_of, (*get_args(Code), *get_args(Outcome)))]
    without = [code for code in names if TABLE[code].text == NO_TEXT]
    assert not without, f"write an entry for {without} into acsard/core/tables or outcomes.py"
    unnamed = TABLE.keys() - set(names)
    assert not unnamed, f"add {sorted(unnamed)} to the Literal beside its table"


def test_every_text_and_every_advice_is_a_sentence() -> None:
    for code, entry in CODES.items():
        why = sentence(cast("Code", code), **dict.fromkeys(names_in(entry), 1))
        assert why.code == code
        assert why.text or code == "nothing"
        assert not re.search(r"[;:]$|  |->", why.text), code
    assert not CODES.keys() & OUTCOMES_BY_CODE.keys()


@pytest.mark.slow
def test_every_call_names_a_code_and_gives_the_values_of_its_texts(nodes: list[ast.AST]) -> None:
    calls = 0
    for node in nodes:
        if not isinstance(node, ast.Call) or not node.args:
            continue
        name = getattr(node.func, "id", getattr(node.func, "attr", ""))
        owner = getattr(getattr(node.func, "value", None), "id", "outcomes")
        if name not in CALLS or owner != "outcomes":
            continue
        given = {keyword.arg for keyword in node.keywords}
        for text in literals(node.args[0]):
            code = code_of(text)
            assert code in TABLE, f"line {node.lineno}: {text} has no row in a table of codes"
            missing = names_in(TABLE[code]) - given if None not in given else ()
            assert not missing, f"line {node.lineno}: {text} needs {missing}"
            calls += 1
    assert calls > 150


def test_every_code_is_used(nodes: list[ast.AST]) -> None:
    """A code that nothing names is left over; an f-string names all that it can make."""
    names: set[str] = set()
    made: list[re.Pattern[str]] = []
    for node in nodes:
        match node:
            case ast.Constant(value=str(text)):
                names.add(code_of(text[:60]))
            case ast.JoinedStr(values=[ast.Constant(value=str(first)), *rest]) if re.fullmatch(
                "[a-z][a-z ]*(_|: )", first
            ):
                ends = [p.value if isinstance(p, ast.Constant) else ".+" for p in rest]
                made.append(re.compile("".join(map(str, [first, *ends]))))
    for code, entry in TABLE.items():
        said = f"{entry.subject}: {code[len(code_of(entry.subject)) + 1 :].replace('_', ' ')}"
        used = code in names or any(p.fullmatch(code) or p.fullmatch(said) for p in made)
        assert used, f"{code} has a row in a table of codes, and nothing names it"


def test_each_stop_and_each_reason_to_rest_says_what_to_do() -> None:
    for code in (*get_args(StopCode), "switched_off", "no_command"):
        assert CODES[code].advice, code


def test_a_code_of_a_later_version_is_shown_as_it_is() -> None:
    later = replace(STATE, code="later_reason", reason="of later", pose_doubt="later_doubt")
    assert later.why == "of later (later_reason)"
    assert [str(why) for why in warnings(later)] == ["pose doubtful: later_doubt"]
    assert level_of("later_reason") == "warning"
    row = DiagnosticStatus(2, "acsard: mode", "of later", "acsar", [KeyValue("code", "later")])
    assert [(f.code, f.level) for f in reported((row,))] == [("later", "failure")]
