"""Adds the git commit of the source to a wheel. hatchling runs this file when it builds a wheel."""

import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CustomBuildHook(BuildHookInterface):
    """Writes the commit into a file of the package, if the source is a git clone."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the file with the commit to the wheel.

        An editable installation gets no file, because acsard then reads the commit from the clone.
        """
        sys.path.insert(0, self.root)
        from acsard.host.version import COMMIT_FILE, commit_of

        commit = commit_of(Path(self.root))
        if commit and version != "editable":
            made = Path(self.directory, "commit")
            made.parent.mkdir(parents=True, exist_ok=True)
            made.write_text(f"{commit}\n")
            build_data["force_include"][str(made)] = f"acsard/{COMMIT_FILE}"
