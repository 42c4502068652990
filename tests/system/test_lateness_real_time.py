"""The daemon uses real-time scheduling and locked memory if permitted, and runs without."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from acsard.host.real_time import WAKE_UP_LATENCY
from tests.system.harness import Daemon, running, until

POLICY = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK


def permitted() -> bool:
    """Return whether this process, and so its daemon, may become real-time and lock memory."""
    capabilities = int(Path("/proc/self/status").read_text().partition("CapEff:")[2].split()[0], 16)
    return bool(capabilities >> 23 & 1 and capabilities >> 14 & 1)  # CAP_SYS_NICE, CAP_IPC_LOCK


needs_permission = pytest.mark.skipif(not permitted(), reason="not permitted here")


def locked_kb(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmLck:")[2].split()[0])


def open_files(pid: int) -> set[str]:
    """Return the files that the process has open."""
    return {os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir()}


@pytest.mark.slow
@needs_permission
def test_the_control_loop_alone_is_real_time_and_memory_is_locked(tmp_path: Path) -> None:
    with running(tmp_path) as (daemon, _):
        policies = {
            int(task.name): os.sched_getscheduler(int(task.name))
            for task in Path(f"/proc/{daemon.pid}/task").iterdir()
        }
        assert policies.pop(daemon.pid) == POLICY
        assert len(policies) > 3, "the bus has threads"
        assert set(policies.values()) == {os.SCHED_OTHER}
        assert locked_kb(daemon.pid) > 0
        assert not Path(WAKE_UP_LATENCY).exists() or WAKE_UP_LATENCY in open_files(daemon.pid)
        assert daemon.events("real_time") == []


@needs_permission
def test_real_time_scheduling_can_be_switched_off(tmp_path: Path) -> None:
    with Daemon(tmp_path, config={"control": {"real_time": False}}) as daemon:
        assert os.sched_getscheduler(daemon.pid) == os.SCHED_OTHER
        assert locked_kb(daemon.pid) == 0
        assert WAKE_UP_LATENCY not in open_files(daemon.pid)
        assert daemon.events("real_time") == []


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can take root's permissions away")
def test_without_permission_the_daemon_runs_without_real_time_and_logs_one_line(
    tmp_path: Path,
) -> None:
    without = ["setpriv", "--bounding-set", "-sys_nice,-ipc_lock"]
    with running(tmp_path, before=without) as (daemon, _):
        assert os.sched_getscheduler(daemon.pid) == os.SCHED_OTHER
        (event,) = daemon.events("real_time")
    assert "no permission for real-time scheduling, locked memory" in event["text"]
    assert "control.real_time = false" in event["text"]


@needs_permission
def test_real_time_scheduling_present_at_the_start_is_not_requested_again(tmp_path: Path) -> None:
    as_a_service = ["chrt", "--fifo", "--reset-on-fork", "5"]
    without = ["setpriv", "--bounding-set", "-sys_nice,-ipc_lock"]
    with Daemon(tmp_path, before=[*as_a_service, *without]) as daemon:
        assert os.sched_getparam(daemon.pid).sched_priority == 5
        (event,) = until(lambda: daemon.events("real_time"), 5.0, "the log")
    assert "no permission for locked memory," in event["text"]
