"""Explains why a TLS endpoint cannot be reached.

Zenoh reports the same error for every cause, so `trouble` repeats the connection step by step with
Python's own TLS.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Mapping
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from acsard.bus.tls_files import (
    CA,
    CERTIFICATE,
    HANDSHAKE_TIMEOUT_S,
    NO_CHECK_TIME,
    host_and_port,
    load,
)
from acsard.core.values import NS_PER_S
from acsard.host import clock

if TYPE_CHECKING:
    # Functions import them, because they take 7 ms, and only programs with TLS need them.
    import socket

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
    load(context, directory)
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
    return f"the certificate of {host} is not valid ({reason}); to make another one, {RENEW_ADVICE}"


def _client_certificate_error(reason: str, host: str, directory: str) -> str:
    # `reason` is OpenSSL's name of the error, usually of an alert that the server sent.
    certificate = f"{directory}/{CERTIFICATE}"
    if reason == "SSLV3_ALERT_CERTIFICATE_EXPIRED":
        return (
            f"{host} says that {certificate} has expired or is not valid yet: if the clocks of "
            f"this machine and of that host are right (`timedatectl`), {RENEW_ADVICE}"
        )
    if "_ALERT_" in reason:
        return (
            f"{host} does not accept {certificate} ({reason}), for example because the robot's "
            "authority did not sign it; get one that `acsard tls add` made for this robot"
        )
    return (
        f"{host} does not speak TLS on this port ({reason}); an endpoint without TLS begins with "
        "tcp/"
    )
