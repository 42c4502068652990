"""How one gets what an extra of `pyproject.toml` brings: acsard is on no package index."""

from __future__ import annotations

from typing import Literal

Extra = Literal["lan", "mcu", "top"]


def install(extra: Extra) -> str:
    """What to type, and where, as the error that says what is missing tells it."""
    return f"pip install '.[{extra}]' in a clone of acsard"
