"""The processes of a benchmark: how one is ended, why one ended by itself, and its cost."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

from acsard.host.errors import Exit, ExitError
from acsard.host.processes import end_with_parent

END_S = 5.0
"""Time limit for the end of a process, s. It usually takes 0.2 s."""


def end_with_us() -> None:
    """End this child process if the benchmark is killed, so that no daemon remains."""
    end_with_parent(signal.SIGTERM)


def leave(process: subprocess.Popen[bytes]) -> None:
    """End a child: first by SIGTERM, then by SIGKILL."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def ended(who: str, code: int, said: str = "") -> ExitError:
    """Return an error that describes the unexpected end of a process."""
    how = f"was ended by signal {-code}" if code < 0 else f"ended with {code}"
    return ExitError(Exit.FAILURE, f"{who} {how}" + (f": {said}" if said else ""))


def daemon_ended(code: int, log: Path) -> ExitError:
    """Return why the daemon ended by itself, with its own message and exit code if it gave them."""
    lines = log.read_text(errors="replace").splitlines()
    # The daemon's log lines are JSON; its reason for ending is plain text.
    said = [line for line in lines if line.strip() and not line.startswith("{")]
    if code in Exit.__members__.values() and code and said:
        return ExitError(Exit(code), said[-1].removeprefix("acsard: "))
    return ended("the daemon", code, said[-1] if said else "")


def processor_ns(pid: int) -> int:
    """Return the processor time of all threads of a process so far, ns."""
    return sum(
        int(task.joinpath("schedstat").read_text().split()[0])
        for task in Path(f"/proc/{pid}/task").iterdir()
    )


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024
