"""Says how to install the libraries of the extras `tools` and `foxglove` in `pyproject.toml`."""

from __future__ import annotations

import shlex
import sys
from typing import Literal

from acsard.host.errors import MendableError

Extra = Literal["foxglove", "tools"]


def install(extra: Extra = "tools") -> str:
    """Return the advice that installs an extra, as the end of a sentence."""
    # acsard is not in any package index, so pip needs the clone.
    return (
        f"type `{shlex.quote(sys.executable)} -m pip install '.[{extra}]'` in the clone of acsard"
    )


def missing(library: str, extra: Extra = "tools") -> MendableError:
    """Return the error of a subcommand whose library is missing."""
    return MendableError(f"this subcommand needs the library {library}: {install(extra)}")
