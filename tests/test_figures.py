"""Each section of the page of figures says when, where and under which load it was measured."""

from __future__ import annotations

import re
import sys

import pytest

from tests.tools.figures import PAGE, SECTIONS, main, with_section

TEXT = PAGE.read_text(encoding="utf-8")
MEASURED = (
    r"\nMeasured 20\d\d-\d\d-\d\d with acsard \S+ on: .+, \d+ cores, \d+ GB, Linux \S+, "
    r"Python \S+, load \d+ when it began\.\n\n(?:\|.+\|\n){3,}\n"
)


def test_each_section_is_measured_and_dated() -> None:
    found = re.findall(r"^<!-- figures (\w+): .* -->\n((?:.*\n)*?)<!-- end -->$", TEXT, re.M)
    assert [name for name, _ in found] == list(SECTIONS)
    for name, body in found:
        assert re.fullmatch(MEASURED, body), name


def test_a_new_measurement_replaces_its_section_only() -> None:
    changed = with_section(TEXT, "page", "Measured again.\n")
    assert "Measured again." in changed
    assert with_section(changed, "page", "Measured again.\n") == changed
    for name in SECTIONS:
        mark = f"<!-- figures {name}:"
        assert changed.count(mark) == TEXT.count(mark) == 1
    assert changed.partition("## The disk")[2] == TEXT.partition("## The disk")[2]


@pytest.mark.parametrize(
    ("words", "said"),
    [(["speed"], "no section speed: choose from daemon"),
     (["packages", "--dist", "nowhere", "--print"], "packages is not measured: name the files")],
)  # fmt: skip
def test_what_cannot_be_measured_is_said(
    words: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["figures", *words])
    try:
        code: object = main()
    except SystemExit as end:
        code = end.code
    assert code
    assert said in capsys.readouterr().err
