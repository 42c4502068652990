"""Tests of the options of `acsard accuracy`."""

from __future__ import annotations

import argparse

import pytest

from acsard.cli import parser
from tests.each import each


def parsed(*words: str) -> argparse.Namespace:
    return parser(["accuracy"]).parse_args(["accuracy", *words])


def test_by_default_the_verb_measures_for_five_seconds_and_ends() -> None:
    args = parsed()
    assert (args.seconds, args.follow, args.json) == (5.0, False, False)


@each("seconds", ["0", "0.5", "601", "nan", "-3", "long"])
def test_measuring_times_out_of_range_are_refused(seconds: str) -> None:
    with pytest.raises(SystemExit):
        parsed("--seconds", seconds)
