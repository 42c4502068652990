"""Adds files to wheel and sdist: the commit of the source and, to wheels, the SBOM (PEP 770) and
the manual. The README of the package has links to the files of that commit.

hatchling runs this file when it builds.
"""

import importlib.util
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface


class ReadmeHook(MetadataHookInterface):
    """Gives the package the README, whose links work outside the repository if it has a home."""

    def update(self, metadata: dict[str, Any]) -> None:
        sys.path.insert(0, self.root)
        from acsard.host.version import source
        from deploy.release import contents

        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        home = metadata.get("urls", {}).get(contents.HOME, "")
        text = contents.with_absolute_links(text, home, source())
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


class CustomBuildHook(BuildHookInterface):
    """Writes the files into a temporary directory.

    A wheel that is made from an sdist gets the commit from the sdist's file. An editable
    installation gets no file, because acsard then reads the commit from the clone.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        sys.path.insert(0, self.root)
        from acsard.host.version import COMMIT_FILE, source_of
        from deploy.release import contents

        if version == "editable":
            return
        self.made = tempfile.TemporaryDirectory()
        if commit := source_of(Path(self.root)):
            made = Path(self.made.name, COMMIT_FILE)
            made.write_text(f"{commit}\n")
            build_data["force_include"][str(made)] = f"acsard/{COMMIT_FILE}"
        if self.target_name == "wheel":
            made = Path(self.made.name, contents.SBOM)
            made.write_text(contents.sbom(self.metadata.version))
            build_data["sbom_files"].append(str(made))
            # Only the environment of a release has zensical, which is ten times as large as acsard.
            if importlib.util.find_spec("zensical"):
                from deploy.manual import build

                made = Path(self.made.name, "manual.zip")
                build.build(made)
                build_data["force_include"][str(made)] = "acsard/manual.zip"
