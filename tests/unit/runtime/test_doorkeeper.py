"""A door that cannot be started is told and tried again: the robot drives on."""

from __future__ import annotations

import asyncio
import sys
import threading

import pytest

from acsard.runtime.doorkeeper import keep_door
from acsard.values import Event


async def told() -> Event:
    """The first that the keeper says."""
    said: asyncio.Queue[Event] = asyncio.Queue()
    keeper = asyncio.create_task(keep_door(["door"], said.put_nowait))
    first = asyncio.create_task(said.get())
    await asyncio.wait({keeper, first}, return_when=asyncio.FIRST_COMPLETED, timeout=10.0)
    assert not keeper.done(), keeper
    keeper.cancel()
    return await first


def test_without_a_program_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    event = asyncio.run(told())
    assert (event.name, event.level) == ("door_ended", "warning")
    assert "could not be started" in event.text


def test_without_room_for_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", full)
    assert "can't start new thread" in asyncio.run(told()).text
