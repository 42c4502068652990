"""Tests of the durations that `acsard bench` and `acsard accuracy` take."""

from __future__ import annotations

import argparse

import pytest

from acsard.cli.common import seconds
from tests.each import each


@each("text", ["0", "0.5", "-1", "inf", "nan", "600.1", "86400"])
def test_a_duration_is_from_a_second_to_ten_minutes(text: str) -> None:
    assert seconds("1") == 1.0
    assert seconds("600") == 600.0
    with pytest.raises(argparse.ArgumentTypeError):
        seconds(text)
