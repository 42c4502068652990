"""Examines the certificate files of bus.tls or --tls."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from acsard.bus.certificates import CA, CERTIFICATE, KEY, ends_ns, require_usable
from acsard.doctor.finding import LEVELS, Finding
from acsard.host.clock import now
from acsard.host.errors import MendableError
from acsard.host.extras import install
from acsard.messages.expiry import expiry


def certificates(tls: str) -> Iterator[Finding]:
    """Yield findings about these files: whether they exist, are private and have not expired.

    Yields nothing if `tls` is "".
    """
    if not tls:
        return
    directory = Path(tls)
    for name in (CA, CERTIFICATE, KEY):
        file = directory / name
        if not os.access(file, os.R_OK):
            text = f"{file} is missing or not yours to read"
            yield Finding("certificates", "failure", text, "`sudo acsard lan init`, or sudo doctor")
        elif name == KEY and file.stat().st_mode & 0o077:
            yield Finding("certificates", "failure", f"others may read {file}", f"chmod 600 {file}")
    try:
        require_usable(tls)
    except MendableError as error:
        yield Finding("certificates", "failure", str(error), "see `acsard lan init --help`")
        return
    ends = ends_ns(tls)
    level, words = expiry(ends, now().wall_ns)
    mend = "`acsard lan renew`, or in a fleet a new one by `lan add`, where ca-key.pem is"
    if ends is None:
        mend = f"{install('lan')}, to have it read"
    yield Finding("certificates", LEVELS[level], words, mend if level else "")
