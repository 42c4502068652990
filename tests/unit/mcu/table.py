"""Rows of a table, as they are found: what was driven, the goal, and what came of it."""

from __future__ import annotations


def print_row(name: str, goal: str, found: str) -> None:
    """Print one, on a line of its own."""
    print(f"\n{name:46} goal {goal:38} found {found}", end="")
