"""`python -m tests.loaded`: run the test command several times on a busy machine, unattended.

Four busy loops run at the same time with the same priority. The test command has no terminal and no
input, ignores SIGINT and SIGHUP as under nohup, and has LC_ALL=C. If root starts this program, the
tests run as the user nobody, who must be able to run this Python. The program prints the time of
each run. The exit code is 0 if no run failed.

`python -m tests.loaded -n 1 -- tests/system` runs one part of the tests once; the words after `--`
go to pytest.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]

NOBODY = 65534

LOOP = "import os, sys\nwhile os.getppid() == int(sys.argv[1]):\n    pass"
"""A busy loop that ends by itself when this program ends."""


class Run(NamedTuple):
    """The result of one run of the test command."""

    seconds: float
    code: int | None
    """None if the run exceeded its time limit."""
    said: str

    @property
    def failed(self) -> list[str]:
        return re.findall(r"^(?:FAILED|ERROR) .*$", self.said, re.M)


@contextmanager
def loops(count: int) -> Iterator[None]:
    """Run this number of busy loops while the body runs."""
    with ExitStack() as stack:
        for _ in range(count):
            words = [sys.executable, "-c", LOOP, str(os.getpid())]
            loop = stack.enter_context(subprocess.Popen(words, stdin=subprocess.DEVNULL))
            stack.callback(loop.kill)
        yield


def plain_user() -> dict[str, object]:
    """Return the arguments with which Popen starts a process as nobody, if this user is root."""
    if os.geteuid() != 0:
        return {}
    return {"user": NOBODY, "group": NOBODY, "extra_groups": []}


def unattended() -> None:
    """Ignore SIGINT and SIGHUP, as nohup does. Popen calls this in the child process."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


def environment(home: Path) -> dict[str, str]:
    """Return a minimal environment in which all writable directories are below `home`."""
    variables = {key: os.environ[key] for key in ("PATH", "VIRTUAL_ENV") if key in os.environ}
    return variables | {
        "HOME": str(home),
        "TMPDIR": str(home),
        "LC_ALL": "C",
        "HYPOTHESIS_STORAGE_DIRECTORY": str(home / "hypothesis"),
        "PYTHONPYCACHEPREFIX": str(home / "compiled"),
    }


def run(home: Path, words: list[str], within: float) -> Run:
    """Run the test command once. Kill it with all its processes after `within` seconds."""
    command = [sys.executable, "-m", "pytest", "-q", "-o", f"cache_dir={home}/cache", *words]
    log, begun = home / "log", time.monotonic()
    with (
        log.open("wb") as out,
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, cwd=ROOT,
            env=environment(home), start_new_session=True, preexec_fn=unattended,
            **plain_user(),  # type: ignore[call-overload]
        ) as tests,
    ):  # fmt: skip
        try:
            code = tests.wait(within)
        except subprocess.TimeoutExpired:
            code = None
            os.killpg(tests.pid, signal.SIGKILL)
    return Run(time.monotonic() - begun, code, log.read_text(errors="replace"))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.loaded", description=__doc__)
    parser.add_argument("-n", "--runs", type=int, default=5)
    parser.add_argument("--loops", type=int, default=4)
    parser.add_argument("--within", type=float, default=900.0, help="seconds for one run")
    parser.add_argument("words", nargs="*", help="for pytest, behind --")
    asked = parser.parse_args()
    done = []
    for number in range(1, asked.runs + 1):
        with tempfile.TemporaryDirectory(prefix="loaded-") as path, loops(asked.loops):
            home = Path(path)
            if plain_user():
                os.chown(home, NOBODY, NOBODY)
            result = run(home, asked.words, asked.within)
        done.append(result)
        *_, last = result.said.strip().splitlines() or ["said nothing"]
        ended = "out of time" if result.code is None else f"exit {result.code}"
        print(f"run {number}: {result.seconds:.0f} s, {ended}: {last.strip('= ')}", flush=True)
        for line in result.failed:
            print(f"    {line}", flush=True)
        if result.code != 0:
            log = Path(tempfile.gettempdir(), f"acsard-loaded-{number}.log")
            log.write_text(result.said)
            print(f"    all of it: {log}", flush=True)
    good = sum(result.code == 0 for result in done)
    print(f"{good} of {len(done)} runs without a failure, beside {asked.loops} busy loops")
    return 0 if good == len(done) else 1


if __name__ == "__main__":
    sys.exit(main())
