"""The page's static files, served from `acsard/web/page` by plain file name only."""

from __future__ import annotations

import gzip
import hashlib
from pathlib import Path

from msgspec import Struct

PAGE = Path(__file__).parent / "page"

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
    ".webmanifest": "application/manifest+json",
}
"""Content type per file suffix. A file with any other suffix is not served."""

PAYS = 1000
"""Minimum size in bytes from which a file is compressed."""


class File(Struct, frozen=True):
    """A file in the form in which it is sent."""

    kind: str
    body: bytes
    packed: bytes | None
    """The gzip form of the body, or None if it is not shorter."""
    tag: str
    stamp: tuple[int, int]


class Files:
    """The files of a directory, cached until they change on disk."""

    def __init__(self, directory: Path = PAGE) -> None:
        self._directory = directory
        self._files: dict[str, File] = {}

    def get(self, name: str) -> File | None:
        """Return the file, or None if it does not exist or the name is not a plain file name."""
        kind = TYPES.get(Path(name).suffix)
        if kind is None or "/" in name or name.startswith("."):
            return None
        path = self._directory / name
        try:
            if path.is_symlink() or not path.is_file():
                return None
            seen = path.stat()
            stamp = seen.st_mtime_ns, seen.st_size
            known = self._files.get(name)
            if known is None or known.stamp != stamp:
                known = self._files[name] = _read(path, kind, stamp)
        except (OSError, ValueError):
            return None
        return known


def _read(path: Path, kind: str, stamp: tuple[int, int]) -> File:
    body = path.read_bytes()
    packed = gzip.compress(body, mtime=0) if len(body) >= PAYS else body
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    return File(kind, body, packed if len(packed) < len(body) else None, tag, stamp)
