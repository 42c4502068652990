"""When a certificate ends. Reading one takes the library of the extra `lan`."""

from __future__ import annotations

from pathlib import Path

from acsard.runtime.zenoh_session import CERTIFICATE
from acsard.values import NS_PER_S


def ends_ns(directory: str) -> int | None:
    """Wall-clock time at which the certificate in `directory` ends; None when it cannot be read."""
    try:
        from cryptography import x509
    except ImportError:
        return None
    try:
        data = (Path(directory) / CERTIFICATE).read_bytes()
        ends = x509.load_pem_x509_certificate(data).not_valid_after_utc
    except (OSError, ValueError):
        return None
    return int(ends.timestamp()) * NS_PER_S
