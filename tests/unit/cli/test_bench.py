"""Tests of the options of `acsard bench`."""

from __future__ import annotations

import argparse

import pytest

from acsard.cli.bench import duration
from tests.each import each


@each("text", ["0", "0.5", "-1", "inf", "nan", "600.1", "86400"])
def test_a_duration_is_from_a_second_to_ten_minutes(text: str) -> None:
    assert duration("1") == 1.0
    assert duration("600") == 600.0
    with pytest.raises(argparse.ArgumentTypeError):
        duration(text)
