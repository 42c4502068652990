"""What holds for every test: the hypothesis profile."""

from __future__ import annotations

from hypothesis import settings

# No deadline: a slow machine must not fail a true sentence.
settings.register_profile("default", deadline=None, max_examples=100)
settings.load_profile("default")
