"""Tests of the output of a service call to one robot."""

from __future__ import annotations

import pytest

from acsard.cli import main
from acsard.host.errors import Exit


@pytest.mark.parametrize(
    ("words", "instead"),
    [
        (["clear", "--id", "*"], ["`acsard call clear --id robot1`", "`acsard fleet` lists"]),
        (["srv/clear", "--id", "a,b"], ["`acsard call clear --id a`, `acsard call clear --id b`"]),
        (["set_pose", "1", "-2", "0.5", "--id", "*"], ["`acsard call set_pose 1 -2 0.5 --id"]),
    ],
)
def test_what_is_not_for_many_says_why_and_what_to_type_instead(
    words: list[str], instead: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["call", *words]) == Exit.USAGE
    told = capsys.readouterr().err
    assert "only stop can be called on several robots at once" in told
    assert "a person must look at each" in told
    assert all(one in told for one in instead)
