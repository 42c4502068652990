"""What holds for every test: the hypothesis profile, and signals as at a terminal."""

from __future__ import annotations

import signal

from hypothesis import settings

# No deadline: a slow machine must not fail a true sentence.
settings.register_profile("default", deadline=None, max_examples=30)
settings.register_profile("thorough", deadline=None, max_examples=300)
"""`pytest --hypothesis-profile thorough`, as `.ci/run` does."""
settings.load_profile("default")

# nohup and a script's `&` start a program with these ignored, and what a test starts inherits that.
# A handler is not inherited; one that does nothing ignores them as well.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)
