"""A pytest plugin: hypothesis without shrinking, as each run ends with its first failure."""

from __future__ import annotations

from hypothesis import Phase, settings

settings.register_profile(
    "mutation", deadline=None, database=None, phases=(Phase.explicit, Phase.generate)
)
