"""Tests of the output of a service call to one robot."""

from __future__ import annotations

import pytest

from acsard.cli import main
from acsard.host.errors import Exit
from tests.each import each


@pytest.mark.parametrize(
    ("words", "instead"),
    [
        (["clear", "--id", "*"], ["`acsard call clear --id robot1`", "`acsard fleet` lists"]),
        (["srv/clear", "--id", "a,b"], ["`acsard call clear --id a`, `acsard call clear --id b`"]),
        (["set_pose", "1", "-2", "0.5", "--id", "*"], ["`acsard call set_pose 1 -2 0.5 --id"]),
    ],
)
def test_a_call_that_is_not_for_several_robots_is_refused_with_alternatives(
    words: list[str], instead: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["call", *words]) == Exit.USAGE
    output = capsys.readouterr().err
    assert "only stop can be called on several robots at once" in output
    assert "a person must look at each" in output
    assert all(word in output for word in instead)


@each("text", ["nan", "inf", "-1e400"])
@each("name", ["X", "Y", "YAW"])
def test_a_number_that_is_not_finite_is_refused_with_its_name(
    name: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    values = [text if name == axis else "0" for axis in ("X", "Y", "YAW")]
    assert main(["call", "set_pose", "--", *values]) == Exit.USAGE
    assert f"{name} = {float(text)}: the number must be finite" in capsys.readouterr().err
