"""The page's static files, served from `acsard/web/page` by plain file name only.

`index.html` has STOP's script and the style in itself, so that STOP arrives with the page: another
file may be late, or never arrive. The policy of the page allows these two by their hashes.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
from collections.abc import Sequence
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

INLINED = {
    "index.html": {
        "stop.js": (b'<script src="page/stop.js"></script>', "script"),
        "style.css": (b'<link rel="stylesheet" href="page/style.css">', "style"),
    }
}
"""The files that another one contains when it is sent, each with the element that loads it in the
source, and the name of the element that contains it."""

PAYS = 1000
"""Minimum size in bytes from which a file is compressed."""


class File(Struct, frozen=True):
    """A file in the form in which it is sent."""

    kind: str
    body: bytes
    packed: bytes | None
    """The gzip form of the body, or None if it is not shorter."""
    tag: str
    policy: str
    """Directives of the content security policy for the files that this one contains."""
    stamp: tuple[tuple[int, int], ...]


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
        paths = [self._directory / one for one in (name, *INLINED.get(name, ()))]
        try:
            if any(path.is_symlink() or not path.is_file() for path in paths):
                return None
            seen = [path.stat() for path in paths]
            stamp = tuple((one.st_mtime_ns, one.st_size) for one in seen)
            known = self._files.get(name)
            if known is None or known.stamp != stamp:
                known = self._files[name] = _read(paths, kind, stamp)
        except (OSError, ValueError):
            return None
        return known


def _read(paths: Sequence[Path], kind: str, stamp: tuple[tuple[int, int], ...]) -> File:
    """Read the first file with the others in it."""
    whole, *parts = paths
    body, policy = whole.read_bytes(), ""
    for part in parts:
        source, (loads, element) = part.read_bytes(), INLINED[whole.name][part.name]
        body = body.replace(loads, f"<{element}>".encode() + source + f"</{element}>".encode())
        digest = base64.b64encode(hashlib.sha256(source).digest()).decode()
        policy += f"; {element}-src 'self' 'sha256-{digest}'"
    packed = gzip.compress(body, mtime=0) if len(body) >= PAYS else body
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    return File(kind, body, packed if len(packed) < len(body) else None, tag, policy, stamp)
