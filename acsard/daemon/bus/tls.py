"""TLS: checks and reads the certificate files, and diagnoses why an endpoint cannot be reached.

Zenoh has one error for all causes. The diagnosis repeats the connection step by step with Python's
own TLS and has a message for each way it ends; it does not open the Zenoh session. Only the end
date of a certificate (`ends_ns`) needs the library of the optional extra `tls`.
"""

from __future__ import annotations

import errno
import ipaddress
import socket
import ssl
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from acsard.core.config.settings import TLS
from acsard.core.values import NS_PER_S
from acsard.host.errors import CertificateError, NotPermittedError

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
            f"there is no directory {directory}: name the directory with {CA}, {CERTIFICATE} and "
            f"{KEY} that `acsard tls init` or `tls add` made"
        )
    for name in (CA, CERTIFICATE, KEY):
        file = Path(directory) / name
        try:
            file.read_bytes()
        except PermissionError:
            raise NotPermittedError(
                f"no permission to read {file}: use sudo, or make your own copies; a service "
                "gets its copies by the drop-in deploy/systemd/lan.conf",
            ) from None
        except OSError as error:
            raise CertificateError(
                f"cannot read {file}: {error.strerror}; `acsard tls init` or `tls add` makes it"
            ) from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_verify_locations(f"{directory}/{CA}")
        # The empty password makes OpenSSL fail for an encrypted key instead of prompting for its
        # password on the terminal. Zenoh accepts no encrypted key.
        context.load_cert_chain(f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}", password="")
    except (ssl.SSLError, ValueError) as error:
        raise CertificateError(
            f"the certificates in {directory} cannot be used ({error}): they are not PEM, or the "
            "key belongs to another certificate or has a password; `acsard tls init` or `tls "
            "add` makes new ones",
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


PATIENCE_S = 2.0
"""Seconds for the server to accept the connection, and again to answer in TLS."""

REFUSAL_S = 0.5
"""A server that rejects our certificate says so at once. One that accepts it waits for data, so
silence of this many seconds means that it accepts it."""

AWAY = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)
"""Errors by which no machine has the address, so that nothing is known about its ports."""

EXPIRED, NOT_YET, WRONG_NAME, WRONG_ADDRESS = 10, 9, 62, 64
"""OpenSSL's verify codes (X509_V_ERR_...). All others mean a certificate of another authority."""


def trouble(endpoint: str, directory: str) -> str:
    """Return what prevents a connection to `endpoint` with these certificates, and how to fix it.

    Returns "" if this machine finds no fault. Takes a few seconds at most.
    """
    # An endpoint may end with options of Zenoh: `?metadata` and `#configuration`.
    bare = endpoint.partition("?")[0].partition("#")[0]
    host, _, port = bare.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    try:
        plain = socket.create_connection((host, int(port)), PATIENCE_S)
    except socket.gaierror:
        return (
            f"the name {host} does not resolve on this machine; write the robot's IP address "
            "(`hostname -I` prints it there; its certificate must contain it), or fix DNS, mDNS "
            "or /etc/hosts"
        )
    except TimeoutError:
        return (
            f"{host} does not answer on port {port}: is it switched on, and does a firewall "
            "drop connections?"
        )
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno in AWAY:
            return (
                f"{host} cannot be reached ({error.strerror}): is it switched on, is it in this "
                "network, is the address right?"
            )
        return (
            f"no program listens on port {port} of {host} ({error}); does the robot's "
            "bus.listen have this address?"
        )
    with plain:
        return _tls_trouble(plain, host, directory)


def _tls_trouble(plain: socket.socket, host: str, directory: str) -> str:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(f"{directory}/{CA}")
    context.load_cert_chain(f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}", password="")
    try:
        with context.wrap_socket(plain, server_hostname=host) as link:
            link.settimeout(REFUSAL_S)
            link.recv(1)
    except ssl.SSLCertVerificationError as error:
        return _of_theirs(error, host, directory)
    except ssl.SSLError as error:
        return _of_ours(error.reason or str(error), host, directory)
    except TimeoutError:
        return ""  # the server waits for data, so both certificates are accepted
    except OSError:
        return f"{host} closes the connection at once: does a TLS endpoint of acsard listen there?"
    return ""


def _of_theirs(error: ssl.SSLCertVerificationError, host: str, directory: str) -> str:
    """Return the message for a server certificate that this machine rejects."""
    now = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    match error.verify_code:
        case code if code == EXPIRED:
            return (
                f"the certificate of {host} has expired, by this machine's clock ({now}); if the "
                "clock is right, run `acsard tls renew` where ca-key.pem is, and restart the "
                "daemon"
            )
        case code if code == NOT_YET:
            return (
                f"the certificate of {host} is not valid yet, by this machine's clock ({now}); "
                "set this clock (`timedatectl`), or set the clock of the machine that made the "
                "certificate and renew it"
            )
        case code if code in (WRONG_NAME, WRONG_ADDRESS):
            return (
                f"the certificate there is not for {host}; connect by a name or address that it "
                f"contains, or run on the robot: `acsard tls renew --address {host}`, and "
                "restart the daemon"
            )
    return (
        f"the certificate of {host} comes from another authority than {directory}/{CA} "
        f"({error.verify_message}); get a directory that `acsard tls` made for this robot"
    )


def _of_ours(reason: str, host: str, directory: str) -> str:
    """Return the message for a client certificate that the server rejects.

    `reason` is OpenSSL's name of the server's TLS alert.
    """
    mine = f"{directory}/{CERTIFICATE}"
    if "CERTIFICATE_EXPIRED" in reason:
        return (
            f"{host} says that {mine} has expired or is not valid yet: make a new one with "
            "`acsard tls add` where ca-key.pem is, or set the clocks of both machines "
            "(`timedatectl`)"
        )
    if "UNKNOWN_CA" in reason or "CERTIFICATE" in reason or "DECRYPT" in reason:
        return (
            f"{host} does not accept {mine}: it comes from another authority than the robot's; "
            "get one that `acsard tls add` made there"
        )
    return f"{host} does not speak TLS here ({reason}); a plain endpoint begins with tcp/"
