"""Starts the asyncio tasks for which no caller waits, or for which several callers wait."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


def start(work: Coroutine[Any, Any, None], tasks: set[asyncio.Task[None]]) -> None:
    """Run `work` in a task, for which no caller waits. `tasks` contains the task until it ends."""
    task = asyncio.create_task(work)
    tasks.add(task)
    task.add_done_callback(tasks.discard)


def shared(work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
    """Run `work` in a task, and return the task. Each caller awaits it with `asyncio.shield`.

    All callers may have gone when the task fails. Therefore, this function retrieves the error too,
    because asyncio logs every error that nothing retrieves.
    """
    task = asyncio.create_task(work)
    task.add_done_callback(lambda done: done.cancelled() or done.exception())
    return task
