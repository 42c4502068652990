"""Tests of the range of numbers that options accept."""

from __future__ import annotations

from acsard.cli import parser


def test_a_number_of_the_range_is_taken() -> None:
    drive = parser(["drive"]).parse_args(["drive", "--linear", "10", "--angular", "0"])
    assert (drive.linear, drive.angular) == (10.0, 0.0)
    assert parser(["echo"]).parse_args(["echo", "odom", "--timeout", "0.01"]).timeout == 0.01
