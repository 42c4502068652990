"""Builds the manual strictly into one zip file, with `index.html` at its top.

    .venv/bin/python deploy/manual/build.py

It needs the extra `manual`, and writes the file that the page of this Python's acsard serves. The
same pages give the same bytes. Unpacked, the site is five times as large, because each page has its
own copy of the contents.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
SHOWN = ".ino"  # the page shows these files; the name of another one gets ".txt"


def build(out: Path) -> None:
    """Write the zip file of the manual."""
    with tempfile.TemporaryDirectory() as place:
        # zensical keeps a cache beside its sources.
        shutil.copytree(HERE / "pages", Path(place, "pages"))
        shutil.copy(HERE / "mkdocs.yml", place)
        carry_files(Path(place, "pages"))
        program = [sys.executable, "-m", "zensical", "build", "--strict", "-f", "mkdocs.yml"]
        done = subprocess.run(program, cwd=place, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"{' '.join(program)} failed:\n{done.stdout}{done.stderr}")
        site = Path(place, "site")
        licence = metadata.distribution("zensical").read_text("licenses/LICENSE.md")
        assert licence is not None
        (site / "assets/LICENSE").write_text(licence)
        files = [path for path in site.rglob("*") if path.is_file()]
        pack(out, {str(path.relative_to(site)): path for path in files})


def carry_files(pages: Path) -> None:
    """Copy each file of the repository to which a page leads, and correct the links.

    A robot without internet has the files of its version. Of a directory it has a zip file.
    """
    for page in pages.rglob("*.md"):
        there = HERE / "pages" / page.relative_to(pages)

        def carried(match: re.Match[str], page: Path = page, there: Path = there) -> str:
            source = (there.parent / match[1]).resolve()
            if source.is_relative_to(HERE / "pages"):
                return match[0]
            copy = pages / "files" / source.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            if source.is_dir():
                copy = copy.with_suffix(".zip")
                files = [path for path in source.rglob("*") if path.is_file()]
                pack(copy, {str(path.relative_to(source.parent)): path for path in files})
            else:
                if copy.suffix != SHOWN:
                    copy = copy.with_name(f"{copy.name}.txt")
                shutil.copy(source, copy)
            return f"]({os.path.relpath(copy, page.parent)})"

        text = page.read_text(encoding="utf-8")
        page.write_text(re.sub(LINK, carried, text), encoding="utf-8")


LINK = r"\]\((\.\.?/[^)#\s]+)(?:#[^)\s]*)?\)"


def pack(out: Path, files: Mapping[str, Path]) -> None:
    """Write a zip file. The same files give the same bytes."""
    with ZipFile(out, "w", ZIP_DEFLATED) as archive:
        for name in sorted(files):
            # A ZipInfo without a date has the same one always.
            archive.writestr(ZipInfo(name), files[name].read_bytes(), ZIP_DEFLATED)


if __name__ == "__main__":
    # The environment of a release builds without the libraries of the page.
    from acsard.web.manual import MANUAL

    build(MANUAL)
    print(f"wrote {MANUAL}; restart the page (`acsard run` or `acsard web`)")
