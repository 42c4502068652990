"""Finds the command that installs an extra, a group of optional libraries in `pyproject.toml`.

acsard is not in any package index. So the command names the directory from which acsard was
installed. If that directory no longer exists, the command names the libraries of the extra.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Literal
from urllib.parse import unquote, urlsplit

from acsard.host.errors import MendableError

Extra = Literal["foxglove", "tls", "web", "write"]


def install(extra: Extra) -> str:
    """Return the shell command that installs an extra.

    Error messages about missing libraries show this command.
    """
    try:
        wanted = requirements_of(distribution("acsard"), extra)
    # acsard runs from its source directory and has not been installed.
    except PackageNotFoundError:
        wanted = [f".[{extra}]"]
    return shlex.join([*_installer(), *wanted])


def missing(library: str, extra: Extra) -> MendableError:
    """Return the error about a missing library, with the command that installs its extra."""
    return MendableError(
        f"this command needs the library {library}; to install it, run: {install(extra)}"
    )


def requirements_of(installed: Distribution, extra: Extra) -> list[str]:
    """Return the arguments of `pip install` that install an extra.

    The result is like ["DIRECTORY[EXTRA]"], with the directory from which acsard was installed. If
    this directory no longer exists, the result contains the names of the extra's libraries.
    `installed` is the metadata of the installed acsard.
    """
    direct_url = json.loads(installed.read_text("direct_url.json") or "{}")
    url = urlsplit(direct_url.get("url", ""))
    place = Path(unquote(url.path))
    if url.scheme == "file" and (place / "pyproject.toml").is_file():
        editable = direct_url.get("dir_info", {}).get("editable", False)
        return [*(["-e"] if editable else []), f"{place}[{extra}]"]
    libraries = (line.partition(";") for line in installed.requires or ())
    only = ["extra", "==", f"'{extra}'"]
    return [name.strip() for name, _, when in libraries if when.split() == only]


def _installer() -> list[str]:
    sudo = [] if os.access(sys.prefix, os.W_OK) else ["sudo"]
    if find_spec("pip"):
        return [*sudo, sys.executable, "-m", "pip", "install"]
    return [*sudo, "uv", "pip", "install", "--python", sys.executable]
