"""A struct type can be split into its primitive fields, in order, and rebuilt from them."""

from __future__ import annotations

from typing import Annotated

import pytest
from msgspec import Meta, Struct, inspect

from acsard.core.messages.cdr_types import builder, leaves, limit, number_code, plain, struct_info
from tests.each import each


class Inner(Struct, frozen=True):
    x: float
    flags: list[bool]


class Outer(Struct, frozen=True):
    first: Inner
    name: str
    count: Annotated[int, Meta(ge=0, lt=10, extra={"cdr": "I"})]
    last: Inner


def field(kind: object) -> inspect.Type:
    return inspect.type_info(kind)


def test_leaves_are_the_fields_in_order_with_their_paths() -> None:
    assert [path for path, _ in leaves(struct_info(Outer))] == [
        "first.x",
        "first.flags",
        "name",
        "count",
        "last.x",
        "last.flags",
    ]


def test_a_builder_makes_the_struct_of_its_leaves() -> None:
    built = builder(struct_info(Outer))(iter([1.0, [True], "a", 3, 2.0, []]))
    assert built == Outer(Inner(1.0, [True]), "a", 3, Inner(2.0, []))


@each("kind", [dict, list[int], float, int])
def test_a_type_that_is_not_a_struct_is_a_type_error(kind: object) -> None:
    with pytest.raises(TypeError, match="not a struct"):
        struct_info(kind)


@each(
    ("kind", "code"),
    [
        (float, "d"),
        (bool, "?"),
        (str, ""),
        (list[float], ""),
        (Annotated[int, Meta(extra={"cdr": "q"})], "q"),
        (Annotated[int, Meta(ge=1, extra={"cdr": "B"})], "B"),
    ],
)
def test_a_number_has_the_code_of_its_width(kind: object, code: str) -> None:
    assert number_code(field(kind)) == code


@pytest.mark.parametrize("kind", [int, Annotated[int, Meta(ge=0)]])
def test_an_int_without_a_width_is_a_type_error(kind: object) -> None:
    with pytest.raises(TypeError, match="width"):
        number_code(field(kind))


@each(
    ("meta", "bounds"),
    [
        (Meta(), None),
        (Meta(ge=0), (0, float("inf"))),
        (Meta(gt=0), (1, float("inf"))),
        (Meta(le=9), (float("-inf"), 9)),
        (Meta(ge=0, lt=10), (0, 9)),
        (Meta(ge=-3, le=3), (-3, 3)),
    ],
)
def test_the_bounds_of_an_int_are_its_smallest_and_largest_permitted_value(
    meta: Meta, bounds: tuple[float, float] | None
) -> None:
    assert limit(field(Annotated[int, meta])) == bounds


def test_only_an_int_has_bounds() -> None:
    assert limit(field(Annotated[float, Meta(ge=0.0)])) is None


def test_the_plain_type_is_found_behind_its_metadata() -> None:
    assert isinstance(plain(field(Annotated[int, Meta(extra={"cdr": "I"})])), inspect.IntType)
    assert isinstance(plain(field(str)), inspect.StrType)
