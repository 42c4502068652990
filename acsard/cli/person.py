"""Who answers what a check asks: somebody at the terminal, or nobody."""

from __future__ import annotations

import sys
from collections.abc import Sequence


class Person:
    """Asks on standard error, so that the findings can go elsewhere; reads the terminal."""

    def say(self, text: str) -> None:
        """Tell what happens now."""
        print(f"   ... {text}", file=sys.stderr, flush=True)

    def ask(self, question: str, answers: Sequence[str]) -> str:
        """One of the answers; the end of the input ends the check."""
        choice = f" [{'/'.join(answers)}]" if len(answers) > 1 else ""
        while True:
            print(f"\n{question}{choice} ", end="", file=sys.stderr, flush=True)
            line = sys.stdin.readline()
            if not line:
                raise KeyboardInterrupt
            word = line.strip().lower()
            if word in answers:
                return word
            print(f"   please type {' or '.join(answers)}", file=sys.stderr)


class Nobody:
    """Confirms what has been said on the command line, and sees nothing."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet

    def say(self, text: str) -> None:
        """Nobody listens; whoever looks at the screen may know."""
        if not self._quiet and sys.stderr.isatty():
            print(f"   ... {text}", file=sys.stderr, flush=True)

    def ask(self, question: str, answers: Sequence[str]) -> str | None:
        """The confirmation; no wheel has been seen to turn."""
        return answers[0] if len(answers) == 1 else None
