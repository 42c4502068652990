"""Loads the files of the built manual, which are in one zip file of the package.

Deflated data of a zip file is gzip with another head and another end, so no file is packed again.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import struct
from pathlib import Path, PurePosixPath
from typing import BinaryIO
from zipfile import ZIP_DEFLATED, BadZipFile, ZipFile, ZipInfo

from acsard.web.answers import CONTENT_TYPES, File

MANUAL = Path(__file__).parents[1] / "manual.zip"

# Those of the files of the repository that the manual carries, too.
MANUAL_TYPES = CONTENT_TYPES | {
    ".ino": "text/plain; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
    ".zip": "application/zip",
}

GZIP_HEAD = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"

MISSING = b"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Manual</title>
<h1>This installation has no manual</h1>
<p>The packages of a release contain the manual of their version. In a clone, these commands make
it for the next start of the page:
<pre>.venv/bin/pip install '.[manual]'
.venv/bin/python deploy/manual/build.py</pre>
<p>A service has its own copy of the program. Then give it this one:
<pre>sudo acsard service upgrade .venv</pre>
<p>The same pages are Markdown in the source, in <code>deploy/manual/pages</code>.
"""


def manual_files(path: Path = MANUAL) -> dict[str, File]:
    """Return the files of the manual by name, or {} if this installation has none.

    The server reads them once, so an upgrade does not change the manual of a running server.
    """
    try:
        with path.open("rb") as file, ZipFile(file) as archive:
            return _load(file, archive)
    except (OSError, BadZipFile):
        return {}


def _load(file: BinaryIO, archive: ZipFile) -> dict[str, File]:
    digests, packed = set[str](), dict[str, tuple[str, str, bytes]]()
    for info in archive.infolist():
        kind = MANUAL_TYPES.get(PurePosixPath(info.filename).suffix)
        if kind is None or info.compress_type != ZIP_DEFLATED:
            continue
        if info.filename.endswith(".html"):
            for source in re.findall(rb"<script>(.*?)</script>", archive.read(info), re.DOTALL):
                digests.add(base64.b64encode(hashlib.sha256(source).digest()).decode())
        packed[info.filename] = kind, f'"{info.CRC:08x}-{info.file_size}"', _gzip(file, info)
    scripts = " ".join(f"'sha256-{digest}'" for digest in sorted(digests))
    policy = (
        f"; script-src 'self' {scripts}; style-src 'self' 'unsafe-inline'; img-src 'self' data:"
    )
    return {name: File(kind, data, tag, policy) for name, (kind, tag, data) in packed.items()}


def _gzip(file: BinaryIO, info: ZipInfo) -> bytes:
    # The head of a file has two fields of any length before the data.
    file.seek(info.header_offset + 26)
    file.seek(sum(struct.unpack("<HH", file.read(4))), os.SEEK_CUR)
    data = file.read(info.compress_size)
    return GZIP_HEAD + data + struct.pack("<II", info.CRC, info.file_size)
