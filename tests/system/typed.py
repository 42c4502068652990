"""What is typed at a shell, run in this process: the start of Python would be most of its time.

For what is printed and the code. Signals, terminals, pipes and how a program ends need a process.
"""

from __future__ import annotations

import io
import time
from contextlib import redirect_stderr, redirect_stdout

from acsard.cli import main
from tests.system.harness import Finished


def typed(*words: str) -> Finished:
    """What became of `acsard` with these words; relative paths are those of this process."""
    out, err, begun = io.StringIO(), io.StringIO(), time.monotonic()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(list(words))
        except SystemExit as end:  # argparse
            code = end.code if isinstance(end.code, int) else 1
    said, wrong = (stream.getvalue().rstrip("\n") for stream in (out, err))
    return Finished(code, said, wrong, time.monotonic() - begun)
