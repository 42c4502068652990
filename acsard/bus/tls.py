"""Checks and reads the certificate files, and explains why a TLS endpoint cannot be reached.

Zenoh reports the same error for every cause, so `trouble` repeats the connection step by step with
Python's own TLS. Only expiry times need the library `cryptography`.
"""

from __future__ import annotations

import errno
import ipaddress
import time
from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsard.core.config.settings import is_tls
from acsard.core.values import NS_PER_S, WallNs
from acsard.host import clock
from acsard.host.errors import CertificateError, NotPermittedError

if TYPE_CHECKING:
    # Functions import them, because they take 7 ms, and only programs with TLS need them.
    import socket
    import ssl

CA, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"


def require_usable(directory: str) -> None:
    """Check that the files of a TLS directory can be read and belong together.

    Raises `CertificateError` or `NotPermittedError`, whose text says how to fix the problem.
    """
    try:
        is_there = Path(directory).is_dir()
    except PermissionError:
        raise NotPermittedError(
            f"no permission to enter the directory that contains {directory}: use sudo, or make "
            "copies of the certificates that you may read"
        ) from None
    if not is_there:
        raise CertificateError(
            f"there is no directory {directory}: name the directory with {CA}, {CERTIFICATE} and "
            f"{KEY} that `acsard tls init` or `acsard tls add` made"
        )
    for name in (CA, CERTIFICATE, KEY):
        file = Path(directory) / name
        try:
            file.read_bytes()
        except PermissionError:
            raise NotPermittedError(
                f"no permission to read {file}: use sudo, or make copies that you may read; a "
                "systemd service gets its copies from the drop-in deploy/systemd/lan.conf",
            ) from None
        except OSError as error:
            raise CertificateError(
                f"cannot read {file}: {error.strerror}; make it with `acsard tls init` or "
                "`acsard tls add`"
            ) from None
    why = unusable(*files_in(directory))
    if why:
        raise CertificateError(
            f"the certificates in {directory} cannot be used ({why}): either they are not PEM, "
            "or the key belongs to another certificate, or the key has a password; make new "
            "certificates with `acsard tls init` or `acsard tls add`",
        )


def files_in(directory: str) -> tuple[Path, Path, Path]:
    """Return the paths of the files in a TLS directory: authority, certificate and key."""
    return Path(directory, CA), Path(directory, CERTIFICATE), Path(directory, KEY)


def unusable(authority: Path, certificate: Path, key: Path) -> str:
    """Return why OpenSSL cannot use these files together, or ""."""
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_verify_locations(authority)
        # If no password is passed, OpenSSL asks on the terminal for the password of an encrypted
        # key. With an empty password, OpenSSL refuses such a key. That is right, because Zenoh does
        # not accept an encrypted key.
        context.load_cert_chain(certificate, key, password="")
    except (OSError, ValueError) as error:
        # SSLError is an OSError.
        return str(error)
    return ""


def common_name(directory: str) -> str:
    """Return the common name of the certificate in `directory`; "" if it cannot be read."""
    subject: Any = _decoded(directory).get("subject", ())
    names = [value for part in subject for kind, value in part if kind == "commonName"]
    return str(names[-1]) if names else ""


def shown_at(endpoint: str, directory: str) -> str:
    """Return the common name of the certificate that this client shows to an endpoint, or ""."""
    return common_name(directory) if directory and is_tls(endpoint) else ""


def names_in(directory: str) -> list[str]:
    """Return the host names and IP addresses for which the certificate is valid."""
    alternative: Any = _decoded(directory).get("subjectAltName", ())
    return [_plain(str(name)) for _, name in alternative]


def _plain(name: str) -> str:
    # `ssl` writes an IPv6 address with all its zeros.
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return name


def _decoded(directory: str) -> dict[str, Any]:
    # The standard library decodes only the certificate of a connected peer. So connect a client and
    # a server in memory, both of which use this certificate.
    import ssl

    server_context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server_context.verify_mode = ssl.CERT_REQUIRED
    # Accept an expired certificate, because its name is needed to say how to replace it.
    server_context.verify_flags |= NO_CHECK_TIME
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        server_context.load_verify_locations(f"{directory}/{CA}")
        _load(server_context, directory)
        client = _trusting(directory).wrap_bio(to_client, to_server)
        server = server_context.wrap_bio(to_server, to_client, server_side=True)
        for end in (client, server, client, server):
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except (OSError, ValueError):
        # SSLError is an OSError.
        return {}
    return dict(server.getpeercert() or {})


NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME, which `ssl` does not name

AUTHORITY = "the authority"  # key of `ca.pem` in `expiry_times()`


def expiry_times(directory: str) -> dict[str, WallNs]:
    """Return when the certificates in a TLS directory expire, or {} if they cannot be read.

    The key "" stands for `certificate.pem`, and `AUTHORITY` for `ca.pem`.
    """
    try:
        from cryptography import x509
    except ImportError:
        return {}
    files = {"": CERTIFICATE, AUTHORITY: CA}
    try:
        certificates = {
            whose: x509.load_pem_x509_certificate((Path(directory) / name).read_bytes())
            for whose, name in files.items()
        }
    except (OSError, ValueError, x509.InvalidVersion):
        return {}
    return {whose: _ends_ns(certificate) for whose, certificate in certificates.items()}


def peer_ends_ns(endpoint: str, directory: str) -> WallNs | None:
    """Return when the certificate at an endpoint expires, without verifying it; None if unknown.

    Each wait for its program lasts at most `HANDSHAKE_TIMEOUT_S`.
    """
    try:
        from cryptography import x509
    except ImportError:
        return None
    import socket

    host, port = host_and_port(endpoint)
    try:
        with (
            socket.create_connection((host, int(port)), HANDSHAKE_TIMEOUT_S) as plain,
            _trusting(directory).wrap_socket(plain) as link,
        ):
            return _ends_ns(x509.load_der_x509_certificate(link.getpeercert(True) or b""))
    except (OSError, ValueError, x509.InvalidVersion):
        return None


def _trusting(directory: str) -> ssl.SSLContext:
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    _load(context, directory)
    return context


def _load(context: ssl.SSLContext, directory: str) -> None:
    context.load_cert_chain(f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}", password="")


def _ends_ns(certificate: Any) -> WallNs:
    return int(certificate.not_valid_after_utc.timestamp()) * NS_PER_S


def host_and_port(endpoint: str) -> tuple[str, str]:
    """Return the host, without brackets, and the port of an endpoint."""
    # An endpoint may end with options for Zenoh: `?metadata` and `#configuration`.
    bare = endpoint.partition("?")[0].partition("#")[0]
    host, _, port = bare.partition("/")[2].rpartition(":")
    return host.strip("[]"), port


HANDSHAKE_TIMEOUT_S = 2.0  # for the TCP connection, and for each answer in the handshake

# A server that rejects the client's certificate says so within this time after the handshake.
REFUSAL_WAIT_S = 0.5

UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)

RENEW_ADVICE = (
    "run `acsard tls renew` on the machine that has ca-key.pem (with `--name NAME` for a robot of "
    "a fleet); this command prints the next step"
)


class DateError(IntEnum):
    """OpenSSL's error codes (X509_V_ERR_...) for the dates of a certificate."""

    NOT_YET_VALID = 9
    EXPIRED = 10


def trouble(endpoint: str, directory: str) -> str:
    """Return why this machine cannot connect to a TLS endpoint, and how to fix that, or "".

    Blocks for a few seconds, or longer if the lookup of the host name is slow.
    """
    import socket

    host, port = host_and_port(endpoint)
    try:
        plain = socket.create_connection((host, int(port)), HANDSHAKE_TIMEOUT_S)
    except TimeoutError:
        return (
            f"{host} does not answer on port {port}: is {host} switched on, and does a firewall "
            "drop connections?"
        )
    except (OSError, ValueError, OverflowError) as error:
        # Since Python 3.13 the lookup also rejects an impossible port.
        if isinstance(error, socket.gaierror) and error.errno != socket.EAI_SERVICE:
            return (
                f"the name {host} does not resolve on this machine; write the robot's IP address "
                "(`hostname -I` on the robot prints it; the robot's certificate must contain this "
                "address), or fix DNS, mDNS or /etc/hosts"
            )
        if isinstance(error, OSError) and error.errno in UNREACHABLE:
            return (
                f"{host} cannot be reached ({error.strerror}): is {host} switched on, is it in "
                "this network, is the address right?"
            )
        return (
            f"no program listens on port {port} of {host} ({error}); if a router should: is it "
            "running? If a robot should: does bus.listen in its acsard.toml contain this address?"
        )
    with plain:
        return _tls_trouble(plain, host, directory)


def _tls_trouble(plain: socket.socket, host: str, directory: str) -> str:
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(f"{directory}/{CA}")
    _load(context, directory)
    # Zenoh ignores the dates of an authority, but OpenSSL rejects each certificate of an expired
    # authority at once. So ignore the dates, to find the reason for which Zenoh cannot connect.
    outdated = any(map(_wrong_date, context.get_ca_certs()))
    if outdated:
        context.verify_flags |= NO_CHECK_TIME
    shaken = False
    try:
        with context.wrap_socket(plain, server_hostname=host) as link:
            shaken = True
            if outdated and (code := _wrong_date(link.getpeercert() or {})):
                return _server_certificate_error(code, "", host, directory)
            link.settimeout(REFUSAL_WAIT_S)
            link.recv(1)
    except ssl.SSLCertVerificationError as error:
        return _server_certificate_error(error.verify_code, error.verify_message, host, directory)
    except ssl.SSLError as error:
        return _client_certificate_error(error.reason or str(error), host, directory)
    except TimeoutError:
        # If the handshake is over, the server waits for data: both ends have accepted the
        # certificates.
        if shaken:
            return ""
        return f"{host} accepts the connection, but does not answer the TLS handshake: restart it"
    except OSError:
        return (
            f"{host} closes the connection immediately: does a TLS endpoint of acsard listen there?"
        )
    return ""


def _wrong_date(certificate: Mapping[str, Any]) -> int:
    import ssl

    now = clock.now().wall_ns / NS_PER_S
    if now > ssl.cert_time_to_seconds(certificate["notAfter"]):
        return DateError.EXPIRED
    if now < ssl.cert_time_to_seconds(certificate["notBefore"]):
        return DateError.NOT_YET_VALID
    return 0


def _server_certificate_error(code: int, reason: str, host: str, directory: str) -> str:
    now = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    match code:
        case DateError.EXPIRED:
            return (
                f"the certificate of {host} has expired, according to this machine's clock "
                f"({now}); if the clock is right, {RENEW_ADVICE}"
            )
        case DateError.NOT_YET_VALID:
            return (
                f"the certificate of {host} is not valid yet, according to this machine's clock "
                f"({now}); either correct this machine's clock (`timedatectl`), or correct the "
                "clock of the machine that made the certificate and then renew the certificate"
            )
        case 62 | 64:  # another host name, another IP address
            return (
                f"the certificate of the server is not for {host}; connect to a name or address "
                f"that the certificate contains, or run `acsard tls renew --address {host}` on the "
                "robot; the command says what to do next"
            )
        case 2 | 7 | 18 | 19 | 20 | 21:  # no chain of signatures leads to the authority
            return (
                f"the authority in {directory}/{CA} did not sign the certificate of {host} "
                f"({reason}); use a certificate directory that `acsard tls add` made for this robot"
            )
        case 47 | 48:  # a name is not permitted, or excluded
            return (
                f"the authority in {directory}/{CA} may not sign for the names in the certificate "
                f"of {host} ({reason}); to make one without these names, {RENEW_ADVICE}"
            )
        case 26:  # the wrong purpose
            return (
                f"the certificate of {host} is not for a TLS server ({reason}); to make one for "
                f"servers and clients, {RENEW_ADVICE}"
            )
    return f"the certificate of {host} is not valid ({reason}); to make another one, {RENEW_ADVICE}"


CERTIFICATE_ALERTS = (
    "SSLV3_ALERT_BAD_CERTIFICATE",
    "SSLV3_ALERT_CERTIFICATE_REVOKED",
    "SSLV3_ALERT_CERTIFICATE_UNKNOWN",
    "SSLV3_ALERT_NO_CERTIFICATE",
    "SSLV3_ALERT_UNSUPPORTED_CERTIFICATE",
    "TLSV13_ALERT_CERTIFICATE_REQUIRED",
)


def _client_certificate_error(reason: str, host: str, directory: str) -> str:
    # `reason` is OpenSSL's name of the error, usually of an alert that the server sent.
    certificate = f"{directory}/{CERTIFICATE}"
    if reason == "SSLV3_ALERT_CERTIFICATE_EXPIRED":
        return (
            f"{host} says that {certificate} has expired or is not valid yet: either make a new "
            "one with `acsard tls add` on the machine that has ca-key.pem, or set the clocks of "
            "this machine and of that host (`timedatectl`)"
        )
    if reason in ("TLSV1_ALERT_UNKNOWN_CA", "TLSV1_ALERT_DECRYPT_ERROR"):
        return (
            f"{host} does not accept {certificate}: the robot's authority did not sign this "
            "certificate; get a certificate that `acsard tls add` made for this robot"
        )
    if reason in CERTIFICATE_ALERTS:
        return (
            f"{host} does not accept {certificate} ({reason}); get a certificate that `acsard tls "
            "add` made for this robot"
        )
    return (
        f"{host} does not speak TLS on this port ({reason}); an endpoint without TLS begins with "
        "tcp/"
    )
