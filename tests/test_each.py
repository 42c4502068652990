"""A test that `each` runs with many parameter sets runs all of them and names those that fail."""

from __future__ import annotations

import inspect

import pytest

from tests.each import each


def test_all_combinations_are_run_and_fixtures_are_left_to_pytest() -> None:
    calls: list[tuple[int, str, int]] = []

    @each("first", [1, 2])
    @each(("second", "third"), [("a", 3), ("b", 4)])
    def test(fixture: list[tuple[int, str, int]], first: int, second: str, third: int) -> None:
        fixture.append((first, second, third))

    assert list(inspect.signature(test).parameters) == ["fixture"]
    test(fixture=calls)
    assert calls == [(1, "a", 3), (1, "b", 4), (2, "a", 3), (2, "b", 4)]


def test_a_failure_names_its_parameter_set() -> None:
    @each("value", range(5))
    def test(value: int) -> None:
        assert value < 3

    with pytest.raises(AssertionError) as caught:
        test()
    assert caught.value.__notes__ == ["with {'value': 3}"]


def test_an_empty_list_of_parameter_sets_fails() -> None:
    @each("value", [])
    def test(value: int) -> None:
        """Fail if it is ever run."""

    with pytest.raises(AssertionError, match="nothing to test"):
        test()
