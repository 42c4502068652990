"""The daemon notices renewed certificate files, and knows when replaced certificates expire."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.bus import certificate_watch as module
from acsard.bus.certificate_watch import (
    FILES_CHECK_PERIOD_NS,
    CertificateFiles,
    watch_certificates,
)
from acsard.bus.tls_files import expiry_times, files_in
from acsard.core.config.settings import BusConfig
from acsard.core.messages.certificate_expiry import DAY_NS, expiry, short_code
from acsard.core.messages.state_warnings import brief, warnings
from acsard.core.values import Event, Instant
from acsard.host import clock
from acsard.machine.authority import Authority
from tests.unit.test_page_metrics import STATE


class Files:
    """The certificate files of a robot, and the watch. Each check advances its simulated clock."""

    def __init__(self, where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.where, self._now_ns = where, 0
        self.authority = Authority.make(where, "test", 10)
        self.issue()
        monkeypatch.setattr(clock, "mono_ns", lambda: self._now_ns)
        self.files = CertificateFiles(*files_in(str(where)))

    def issue(self) -> None:
        self.authority.issue(self.where, "robot", [], 10)

    def renewed(self) -> bool:
        self._now_ns += FILES_CHECK_PERIOD_NS
        return self.files.renewed()


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Files:
    return Files(tmp_path, monkeypatch)


def test_each_new_certificate_is_noticed_once(files: Files) -> None:
    assert [files.renewed() for _ in range(3)] == [False, False, False]
    for _ in range(3):
        files.issue()
        # The first look sees that the files change, and the second that they no longer do.
        assert [files.renewed() for _ in range(4)] == [False, True, False, False]
    files.issue()
    assert not any(files.files.renewed() for _ in range(10)), "before the next look is due"


@pytest.mark.parametrize("missing", ["certificate.pem", "key.pem"])
def test_files_copied_one_by_one_count_when_all_are_present(files: Files, missing: str) -> None:
    file = files.where / missing
    old = file.read_bytes()
    files.issue()
    new = file.read_bytes()
    file.write_bytes(old)
    assert [files.renewed() for _ in range(4)] == [False] * 4
    file.unlink()
    assert [files.renewed() for _ in range(4)] == [False] * 4
    file.write_bytes(new)
    assert [files.renewed() for _ in range(2)] == [False, True]


ROUTER = "tls/router.local:7447"


async def until(look: Callable[[], object]) -> None:
    async with asyncio.timeout(10.0):
        while not look():
            await asyncio.sleep(0.005)


async def test_new_files_and_a_new_router_are_noticed_and_missing_ones_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority = Authority.make(tmp_path, "test", 10)
    authority.issue(tmp_path, "robot", [], 10)
    router: list[int | None] = [None]
    monkeypatch.setattr(module, "EXPIRY_CHECK_PERIOD_S", 0.0)
    monkeypatch.setattr(module, "ROUTER_CHECK_EVERY", 2)
    monkeypatch.setattr(module, "peer_ends_ns", lambda endpoint, tls: router[0])
    known = expiry_times(str(tmp_path))
    first = known[""]
    bus = BusConfig(mode="client", connect=(ROUTER,), tls=str(tmp_path))
    events: list[Event] = []
    task = asyncio.create_task(watch_certificates(bus, known, events.append))
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
    # All of the test's certificates end within 30 days, and the router's have ended.
    assert [event.code for event in events] == ["certificate_expires", "certificate_expired"]
    assert "acsard tls renew" in events[1].text
    assert f"(certificate of the router {ROUTER})" in events[1].text
    task.cancel()


async def test_the_log_and_the_fleet_say_30_7_and_1_days_before_without_a_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Authority.make(tmp_path, "test", 400).issue(tmp_path, "robot", [], 100)
    known = expiry_times(str(tmp_path))
    left = 31.0
    monkeypatch.setattr(
        clock, "now", lambda: Instant(mono_ns=0, wall_ns=known[""] - int(left * DAY_NS))
    )
    monkeypatch.setattr(module, "EXPIRY_CHECK_PERIOD_S", 0.0)
    events: list[Event] = []
    readings = 0

    def read(tls: str) -> dict[str, int]:
        nonlocal readings
        readings += 1
        return {}

    monkeypatch.setattr(module, "expiry_times", read)
    bus = BusConfig(tls=str(tmp_path))
    task = asyncio.create_task(watch_certificates(bus, known, events.append))
    fleet = {}
    for left in (31.0, 29.9, 20.0, 7.1, 6.9, 1.5, 0.9, 0.1, -0.1):
        before = readings
        await until(lambda: readings > before + 2)  # noqa: B023
        why = expiry(known, clock.now().wall_ns)
        state = replace(STATE, certificate=short_code(why), certificate_expiry=why.text)
        fleet[left] = brief(warnings(state)).removeprefix("WARNING: certificate ")
    task.cancel()
    assert [event.text.partition(";")[0] for event in events] == [
        "expires in 30 days",
        "expires in 7 days",
        "expires in 22 hours",
        "expired 2 hours ago: TLS refuses every client",
    ]
    assert fleet[31.0] == ""
    assert (fleet[20.0], fleet[1.5], fleet[0.1]) == (
        "expires in 20 days",
        "expires in 36 hours",
        "expires in 2 hours",
    )
