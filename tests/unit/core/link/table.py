"""Prints rows of a result table: the drive, the goal and the result."""

from __future__ import annotations


def print_row(name: str, goal: str, result: str) -> None:
    """Print one row on its own line."""
    print(f"\n{name:46} goal {goal:38} found {result}", end="")
