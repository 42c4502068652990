"""Says how to install the libraries of the extras `tools` and `foxglove` in `pyproject.toml`."""

from __future__ import annotations

import json
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from acsard.host.errors import MendableError

Extra = Literal["foxglove", "tools"]

# A library that acsard has only with this extra.
_LIBRARIES = {"foxglove": "foxglove", "tools": "aiohttp"}


def install(extra: Extra = "tools") -> str:
    """Return the advice that installs an extra, as the end of a sentence."""
    came_from, installer = _url(), _installer()
    extras: str = extra
    if not installer.endswith(" -m pip install"):
        # uv and pipx make the environment anew, without the extras that the command omits.
        there = {name for name, library in _LIBRARIES.items() if find_spec(library)}
        extras = ",".join(sorted({extra, *there}))
    if came_from.endswith(".whl"):
        return f"type `{installer} 'acsard[{extras}] @ {came_from}'`"
    if came_from:
        return f"type `{installer} '.[{extras}]'` in the clone of acsard"
    return f"type `{installer} 'acsard[{extras}]'`"


def missing(library: str, extra: Extra = "tools") -> MendableError:
    """Return the error of a subcommand whose library is missing."""
    return MendableError(f"this subcommand needs the library {library}: {install(extra)}")


def _url() -> str:
    # The file or directory from which acsard was installed, or "" if an index had it (PEP 610).
    from importlib.metadata import PackageNotFoundError, distribution  # slow, and rarely needed

    try:
        text = distribution("acsard").read_text("direct_url.json")
    except PackageNotFoundError:
        return ""
    return "" if text is None else str(json.loads(text)["url"])


def _installer() -> str:
    # uv and pipx keep these files in the environments that they make. Outside of an environment,
    # Debian's pip refuses to install anything.
    if Path(sys.prefix, "uv-receipt.toml").exists():
        return "uv tool install"
    if Path(sys.prefix, "pipx_metadata.json").exists() or sys.prefix == sys.base_prefix:
        return "pipx install --force"
    return f"{shlex.quote(sys.executable)} -m pip install"
