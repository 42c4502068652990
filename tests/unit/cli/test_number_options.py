"""Tests of the range of numbers that options accept."""

from __future__ import annotations

import pytest

from acsard.cli import main, parser
from acsard.host.errors import Exit
from tests.each import each


@each(
    ("option", "allowed"),
    [
        ("echo odom --timeout", "seconds from 0.01 to 86400"),
        ("drive --linear", "m/s from 0 to 10"),
        ("drive --angular", "rad/s from 0 to 50"),
    ],
)
@each("text", ["-1", "nan", "inf", "1e308", "1e400", "fast"])
def test_a_number_out_of_its_range_is_refused_with_the_range(
    option: str, allowed: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*option.split(), text])
    assert ended.value.code == Exit.USAGE
    assert f"{text} is not a number of {allowed}" in capsys.readouterr().err


def test_a_number_of_the_range_is_taken() -> None:
    drive = parser(["drive"]).parse_args(["drive", "--linear", "10", "--angular", "0"])
    assert (drive.linear, drive.angular) == (10.0, 0.0)
    assert parser(["echo"]).parse_args(["echo", "odom", "--timeout", "0.01"]).timeout == 0.01
