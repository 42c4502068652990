"""Starts the asyncio tasks for which no caller waits, or for which several callers wait."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


def start(work: Coroutine[Any, Any, None], tasks: set[asyncio.Task[None]]) -> None:
    """Run `work` in a task that `tasks` contains until it ends."""
    task = asyncio.create_task(work)
    tasks.add(task)
    task.add_done_callback(tasks.discard)


def shared(work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
    """Run `work` in a task, which each caller awaits with `asyncio.shield`.

    Its error counts as retrieved even if all callers have gone, because asyncio logs any other.
    """
    task = asyncio.create_task(work)
    task.add_done_callback(lambda done: done.cancelled() or done.exception())
    return task
