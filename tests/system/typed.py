"""Run a shell command in this process, because starting Python would take most of its time.

It serves for the output and the exit code. Signals, terminals, pipes and the end of a program need
a process.
"""

from __future__ import annotations

import io
import os
import sys
import time
from contextlib import redirect_stderr, redirect_stdout

from acsard.cli import main
from tests.system.harness import Finished


def typed(*words: str) -> Finished:
    """Return the result of `acsard` with these words, without a terminal.

    Relative paths are those of this process.
    """
    out, err, begun = io.StringIO(), io.StringIO(), time.monotonic()
    before = sys.stdin
    with open(os.devnull) as sys.stdin, redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(list(words))
        except SystemExit as end:  # argparse
            code = end.code if isinstance(end.code, int) else 1
        finally:
            sys.stdin = before
    said, wrong = (stream.getvalue().rstrip("\n") for stream in (out, err))
    return Finished(code, said, wrong, time.monotonic() - begun)
