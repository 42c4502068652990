"""Tests of the options of `acsard accuracy`."""

from __future__ import annotations

import argparse

import pytest

from acsard.cli import parser
from tests.each import each


def parsed(*words: str) -> argparse.Namespace:
    return parser(["accuracy"]).parse_args(["accuracy", *words])


def test_it_looks_for_ten_seconds_and_ends() -> None:
    args = parsed()
    assert (args.seconds, args.follow, args.json) == (5.0, False, False)


@each("seconds", ["0", "0.5", "601", "nan", "-3", "long"])
def test_times_that_tell_nothing_are_refused(seconds: str) -> None:
    with pytest.raises(SystemExit):
        parsed("--seconds", seconds)
