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
from acsard.core.codes import Reason, reason
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


def trouble(endpoint: str, directory: str) -> Reason | None:
    """Return why this machine cannot connect to a TLS endpoint, and how to fix that.

    Blocks for a few seconds, or longer if the lookup of the host name is slow.
    """
    import socket

    host, port = host_and_port(endpoint)
    try:
        plain = socket.create_connection((host, int(port)), HANDSHAKE_TIMEOUT_S)
    except TimeoutError:
        return reason("tls_no_answer", host=host, port=port)
    except (OSError, ValueError, OverflowError) as error:
        # Since Python 3.13 the lookup also rejects an impossible port.
        if isinstance(error, socket.gaierror) and error.errno != socket.EAI_SERVICE:
            return reason("tls_no_name", host=host)
        if isinstance(error, OSError) and error.errno in UNREACHABLE:
            return reason("tls_no_route", host=host, reason=error.strerror)
        return reason("tls_no_program", host=host, port=port, reason=error)
    with plain:
        return _tls_trouble(plain, host, port, directory)


def _tls_trouble(plain: socket.socket, host: str, port: str, directory: str) -> Reason | None:
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
    except (ssl.SSLEOFError, ssl.SSLSyscallError, ssl.SSLZeroReturnError):
        return reason("tls_closed", host=host, port=port)
    except ssl.SSLError as error:
        why = error.reason or str(error)
        if "_ALERT_" not in why:
            return reason("tls_not_spoken", host=host, port=port, reason=why)
        return _client_certificate_error(why, host, directory)
    except TimeoutError:
        # If the handshake is over, the server waits for data: both ends have accepted the
        # certificates.
        return None if shaken else reason("tls_handshake_hangs", host=host, port=port)
    except OSError:
        return reason("tls_closed", host=host, port=port)
    return None


def _wrong_date(certificate: Mapping[str, Any]) -> int:
    import ssl

    now = clock.now().wall_ns / NS_PER_S
    if now > ssl.cert_time_to_seconds(certificate["notAfter"]):
        return DateError.EXPIRED
    if now < ssl.cert_time_to_seconds(certificate["notBefore"]):
        return DateError.NOT_YET_VALID
    return 0


def _server_certificate_error(code: int, why: str, host: str, directory: str) -> Reason:
    now = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    match code:
        case DateError.EXPIRED:
            return reason("tls_server_expired", host=host, now=now, renew=RENEW_ADVICE)
        case DateError.NOT_YET_VALID:
            return reason("tls_server_early", host=host, now=now)
        case 62 | 64:  # another host name, another IP address
            return reason("tls_server_other_name", host=host)
        case 2 | 7 | 18 | 19 | 20 | 21:  # no chain of signatures leads to the authority
            return reason(
                "tls_server_not_signed", host=host, directory=directory, ca=CA, reason=why
            )
    return reason("tls_server_invalid", host=host, reason=why, renew=RENEW_ADVICE)


def _client_certificate_error(why: str, host: str, directory: str) -> Reason:
    # `why` is OpenSSL's name of the error, usually of an alert that the server sent.
    certificate = f"{directory}/{CERTIFICATE}"
    if why == "SSLV3_ALERT_CERTIFICATE_EXPIRED":
        return reason("tls_own_expired", host=host, certificate=certificate, renew=RENEW_ADVICE)
    return reason("tls_own_refused", host=host, certificate=certificate, reason=why)
