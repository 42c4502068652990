"""Builds the manual strictly into one zip file, with `index.html` at its top.

    .venv/bin/python deploy/manual/build.py

It needs the extra `manual`, and writes the file that the page of this Python's acsard serves. The
same pages give the same bytes. Unpacked, the site is five times as large, because each page has its
own copy of the contents.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

HERE = Path(__file__).resolve().parent
REPOSITORY = "https://github.com/acsard/acsard/blob/HEAD"
SKETCH = "firmware/acsar/acsar.ino"


def build(out: Path) -> None:
    """Write the zip file of the manual."""
    with tempfile.TemporaryDirectory() as place:
        # zensical keeps a cache beside its sources.
        shutil.copytree(HERE / "pages", Path(place, "pages"))
        shutil.copy(HERE / "mkdocs.yml", place)
        # A robot without internet has the sketch of its version, beside the page that leads to it.
        shutil.copy(HERE.parent / SKETCH, Path(place, "pages/howto"))
        flash = Path(place, "pages/howto/flash.md")
        flash.write_text(flash.read_text().replace(f"{REPOSITORY}/deploy/{SKETCH}", "acsar.ino"))
        program = [sys.executable, "-m", "zensical", "build", "--strict", "-f", "mkdocs.yml"]
        done = subprocess.run(program, cwd=place, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"{' '.join(program)} failed:\n{done.stdout}{done.stderr}")
        site = Path(place, "site")
        licence = metadata.distribution("zensical").read_text("licenses/LICENSE.md")
        assert licence is not None
        (site / "assets/LICENSE").write_text(licence)
        with ZipFile(out, "w", ZIP_DEFLATED) as archive:
            for file in sorted(path for path in site.rglob("*") if path.is_file()):
                # A ZipInfo without a date has the same one always.
                name = ZipInfo(str(file.relative_to(site)))
                archive.writestr(name, file.read_bytes(), ZIP_DEFLATED)


if __name__ == "__main__":
    # The environment of a release builds without the libraries of the page.
    from acsard.web.manual import MANUAL

    build(MANUAL)
    print(f"wrote {MANUAL}; restart the page (`acsard run` or `acsard web`)")
