"""Run an acsard command in this process, because starting Python would take most of its time.

Use this to test the output and the exit code. Tests of signals, terminals, pipes and the end of a
program need a separate process.
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
    """Run `acsard` with these words and without a terminal, and return the result.

    Relative paths start at this process's working directory.
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
    output, wrong = (stream.getvalue().rstrip("\n") for stream in (out, err))
    return Finished(code, output, wrong, time.monotonic() - begun)
