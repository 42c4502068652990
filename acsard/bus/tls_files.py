"""Checks and reads the certificate files. Only expiry times need the library `cryptography`."""

from __future__ import annotations

import ipaddress
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsard.core.config.settings import Config, is_tls
from acsard.core.values import NS_PER_S, WallNs
from acsard.host.errors import CertificateError, NotPermittedError

if TYPE_CHECKING:
    # Functions import them, because they take 7 ms, and only programs with TLS need them.
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
    require_usable_files(*files_in(directory))


def require_usable_files(authority: Path, certificate: Path, key: Path) -> None:
    """Check three files as `require_usable` does."""
    for file in (authority, certificate, key):
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
    why = unusable(authority, certificate, key)
    if why:
        raise CertificateError(
            f"the certificates in {certificate.parent} cannot be used ({why}): either they are not "
            "PEM, or the key belongs to another certificate, or the key has a password; make new "
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


def name_warnings(config: Config) -> list[str]:
    """Return a warning if the access rules of a TLS router would hide the daemon from everyone."""
    bus, robot_id = config.bus, config.robot.id
    name = common_name(bus.tls) if bus.tls_routers else ""
    if name in ("", robot_id):
        return []
    return [
        f'robot.id = "{robot_id}", but the name of the certificate in {bus.tls} is "{name}": a '
        "router of `acsard tls router` lets a robot use only the id that is the name of its "
        "certificate, and would hide this one from everyone; write the same name into both"
    ]


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
        load(server_context, directory)
        client = _trusting(directory).wrap_bio(to_client, to_server)
        server = server_context.wrap_bio(to_server, to_client, server_side=True)
        for end in (client, server, client, server):
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except (OSError, ValueError):
        # SSLError is an OSError.
        return {}
    return dict(server.getpeercert() or {})


HANDSHAKE_TIMEOUT_S = 2.0  # for the TCP connection, and for each answer in the handshake

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
    load(context, directory)
    return context


def load(context: ssl.SSLContext, directory: str) -> None:
    context.load_cert_chain(f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}", password="")


def _ends_ns(certificate: Any) -> WallNs:
    return int(certificate.not_valid_after_utc.timestamp()) * NS_PER_S


def host_and_port(endpoint: str) -> tuple[str, str]:
    """Return the host, without brackets, and the port of an endpoint."""
    # An endpoint may end with options for Zenoh: `?metadata` and `#configuration`.
    bare = endpoint.partition("?")[0].partition("#")[0]
    host, _, port = bare.partition("/")[2].rpartition(":")
    return host.strip("[]"), port
