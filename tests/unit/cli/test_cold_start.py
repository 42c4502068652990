"""A stop leaves quickly from a cold start: its subcommand loads no library for other work."""

from __future__ import annotations

import subprocess
import sys

# Each takes 1 to 20 ms of processor time to load.
SLOW = {
    "acsard.bus.access", "acsard.core.incoming.queries", "acsard.core.messages.json_schema",
    "asyncio", "concurrent.futures", "cryptography", "difflib", "hashlib", "logging", "numpy",
    "rich", "socket", "ssl", "structlog", "subprocess", "tempfile", "tomllib",
}  # fmt: skip


def test_call_loads_no_slow_library() -> None:
    code = "import sys; from acsard.cli import parser; parser(['call']); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert SLOW & set(done.stdout.split()) == set()
