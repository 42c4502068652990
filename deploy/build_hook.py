"""Adds the git commit of the source to wheel and sdist. hatchling runs this file when it builds."""

import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CustomBuildHook(BuildHookInterface):
    """Writes the commit into a file of the package, if the source is a git clone.

    A wheel that is made from an sdist gets the file of the sdist. An editable installation gets no
    file, because acsard then reads the commit from the clone.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        sys.path.insert(0, self.root)
        from acsard.host.version import COMMIT_FILE, source_of

        commit = source_of(Path(self.root))
        if commit and version != "editable":
            self.made = tempfile.TemporaryDirectory()
            made = Path(self.made.name, COMMIT_FILE)
            made.write_text(f"{commit}\n")
            build_data["force_include"][str(made)] = f"acsard/{COMMIT_FILE}"
