"""Checks the files of a TLS directory and reads the names and the end date of its certificate.

Only the end date (`ends_ns`) needs the library of the optional extra `lan`.
"""

from __future__ import annotations

import ipaddress
import ssl
from contextlib import suppress
from pathlib import Path
from typing import Any

from acsard.config.settings import TLS
from acsard.host.errors import CertificateError, NotPermittedError
from acsard.values import NS_PER_S

CA, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"
"""File names in a TLS directory."""


def require_usable(directory: str) -> None:
    """Check that the files of a TLS directory can be read and belong together.

    Raises:
        CertificateError: a file is missing or unusable; the message says how to fix it.
        NotPermittedError: a file may not be read; the message says how to fix it.
    """
    if not Path(directory).is_dir():
        raise CertificateError(
            f"there is no directory {directory}: name the one with {CA}, {CERTIFICATE} and {KEY} "
            "that `acsard lan init` or `lan add` made"
        )
    for name in (CA, CERTIFICATE, KEY):
        file = Path(directory) / name
        try:
            file.read_bytes()
        except PermissionError:
            raise NotPermittedError(
                f"no permission to read {file}: sudo, or copies of your own; a service gets its "
                "copies by the drop-in deploy/systemd/lan.conf",
            ) from None
        except OSError as error:
            raise CertificateError(
                f"cannot read {file}: {error.strerror}; `acsard lan init` or `lan add` makes it"
            ) from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_verify_locations(f"{directory}/{CA}")
        # The empty password makes OpenSSL fail for an encrypted key instead of prompting for its
        # password on the terminal. Zenoh accepts no encrypted key.
        context.load_cert_chain(f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}", password="")
    except (ssl.SSLError, ValueError) as error:
        raise CertificateError(
            f"the certificates in {directory} cannot be used ({error}): not PEM, or the key is of "
            "another certificate or has a password; `acsard lan init` or `lan add` makes them",
        ) from None


def common_name(directory: str) -> str:
    """Return the common name of the certificate in `directory`, "" if it cannot be read."""
    subject: Any = _shown(directory).get("subject", ())
    names = [value for part in subject for kind, value in part if kind == "commonName"]
    return str(names[-1]) if names else ""


def shown_at(endpoint: str, directory: str) -> str:
    """Return the common name that a client presents at this endpoint, "" without a certificate."""
    return common_name(directory) if directory and endpoint.startswith(TLS) else ""


def names_in(directory: str) -> list[str]:
    """Return the host names and addresses that the certificate in `directory` is valid for."""
    alternative: Any = _shown(directory).get("subjectAltName", ())
    return [_plain(str(name)) for _, name in alternative]


def _plain(name: str) -> str:
    """Return an IPv6 address in its short form, because the standard library writes every zero."""
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return name


def _shown(directory: str) -> dict[str, Any]:
    """Return the decoded certificate in `directory`, or an empty dict if it cannot be read.

    The standard library decodes only the certificate of a connected peer. This function therefore
    connects a TLS client and a TLS server in memory, which both use this certificate.
    """
    shown = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    asks, shows = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    shown.verify_mode = ssl.CERT_REQUIRED
    try:
        shown.load_verify_locations(f"{directory}/{CA}")
        for context in (shown, client):
            context.load_cert_chain(f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}", password="")
        one = client.wrap_bio(asks, shows)
        other = shown.wrap_bio(shows, asks, server_side=True)
        for side in (one, other, one, other):
            with suppress(ssl.SSLWantReadError):
                side.do_handshake()
    except (OSError, ValueError):  # SSLError is an OSError
        return {}
    return dict(other.getpeercert() or {})


def ends_ns(directory: str) -> int | None:
    """Return when the certificate in `directory` or its authority's expires, whichever is first.

    The result is wall-clock time in ns, or None if it cannot be read.
    """
    try:
        from cryptography import x509
    except ImportError:
        return None
    try:
        files = [(Path(directory) / name).read_bytes() for name in (CERTIFICATE, CA)]
        ends = [x509.load_pem_x509_certificate(data).not_valid_after_utc for data in files]
    except (OSError, ValueError):
        return None
    return int(min(ends).timestamp()) * NS_PER_S
