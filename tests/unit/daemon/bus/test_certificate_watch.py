"""The daemon knows the ends of certificates that were replaced while it ran."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from acsard.core.config.settings import BusConfig
from acsard.daemon.bus import certificate_watch as module
from acsard.daemon.bus.certificate_watch import watch_certificates
from acsard.daemon.bus.tls import ends
from acsard.machine.authority import Authority

ROUTER = "tls/router.local:7447"


async def until(look: Callable[[], object]) -> None:
    async with asyncio.timeout(10.0):
        while not look():
            await asyncio.sleep(0.005)


def test_new_files_and_a_new_router_are_known_and_an_absent_one_takes_nothing_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority = Authority.make(tmp_path, "test", 10)
    authority.issue(tmp_path, "robot", [], 10)
    router: list[int | None] = [None]
    monkeypatch.setattr(module, "LOOK_S", 0.0)
    monkeypatch.setattr(module, "ROUTER_LOOKS", 2)
    monkeypatch.setattr(module, "peer_ends_ns", lambda endpoint, tls: router[0])

    async def story() -> None:
        known = ends(str(tmp_path))
        first = known[""]
        bus = BusConfig(mode="client", connect=(ROUTER,), tls=str(tmp_path))
        task = asyncio.create_task(watch_certificates(bus, known))
        authority.issue(tmp_path, "robot", [], 20)
        await until(lambda: known[""] > first)
        router[0] = 7
        await until(lambda: known.get(f"the router {ROUTER}") == 7)
        router[0] = 8
        await until(lambda: known.get(f"the router {ROUTER}") == 8)
        router[0] = None
        (tmp_path / "certificate.pem").unlink()
        await asyncio.sleep(0.1)
        assert known.keys() == {"", "the authority", f"the router {ROUTER}"}
        task.cancel()

    asyncio.run(story())


def test_a_disk_that_hangs_takes_one_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, answers = list[int](), threading.Event()

    def hang(directory: str) -> dict[str, int]:
        begun.append(1)
        answers.wait()
        return {"": 8}

    monkeypatch.setattr(module, "LOOK_S", 0.0)
    monkeypatch.setattr(module, "PATIENCE_S", 0.0, raising=False)
    monkeypatch.setattr(module, "ends", hang)

    async def story() -> None:
        known = {"": 7}
        task = asyncio.create_task(watch_certificates(BusConfig(tls=str(tmp_path)), known))
        await asyncio.sleep(0.1)
        assert len(begun) == 1
        answers.set()
        await until(lambda: known[""] == 8)
        task.cancel()

    asyncio.run(story())


def test_the_robots_own_end_is_left_to_its_gateway(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Authority.make(tmp_path, "test", 10).issue(tmp_path, "robot", [], 10)
    monkeypatch.setattr(module, "LOOK_S", 0.0)

    async def story() -> None:
        known = {"": 7}
        bus = BusConfig(listen=("tcp/127.0.0.1:1", "tls/0.0.0.0:7449"), tls=str(tmp_path))
        task = asyncio.create_task(watch_certificates(bus, known))
        await until(lambda: "the authority" in known)
        assert known[""] == 7
        task.cancel()

    asyncio.run(story())
