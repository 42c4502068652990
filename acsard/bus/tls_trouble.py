"""Diagnoses why a TLS endpoint cannot be reached, step by step: Zenoh has one error for all causes.

The module repeats the connection with Python's own TLS and has a message for each way it ends. It
does not open the Zenoh session.
"""

from __future__ import annotations

import errno
import socket
import ssl
import time

from acsard.bus.certificates import CA, CERTIFICATE, KEY

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
            "(`hostname -I` there; its certificate must have it), or mend DNS, mDNS or /etc/hosts"
        )
    except TimeoutError:
        return f"{host} is silent on port {port}: is it on, and does a firewall drop connections?"
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno in AWAY:
            return (
                f"{host} is not there ({error.strerror}): is it on, is it in this network, is the "
                "address its own?"
            )
        return f"nobody listens on port {port} of {host} ({error}); is the robot's bus.listen this?"
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
        return f"{host} ends the connection at once: is a TLS endpoint of acsard there?"
    return ""


def _of_theirs(error: ssl.SSLCertVerificationError, host: str, directory: str) -> str:
    """Return the message for a server certificate that this machine rejects."""
    now = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    match error.verify_code:
        case code if code == EXPIRED:
            return (
                f"the certificate of {host} has ended, by this machine's clock ({now}); if that is "
                "right: `acsard lan renew` where ca-key.pem is, and restart the daemon"
            )
        case code if code == NOT_YET:
            return (
                f"the certificate of {host} does not count yet by this machine's clock ({now}); "
                "set this clock (`timedatectl`), or that of the machine that made it and renew"
            )
        case code if code in (WRONG_NAME, WRONG_ADDRESS):
            return (
                f"the certificate there is not for {host}; connect by a name or address it has, or "
                f"on the robot: `acsard lan renew --address {host}`, and restart the daemon"
            )
    return (
        f"the certificate of {host} is of another authority than {directory}/{CA} "
        f"({error.verify_message}); get a directory made by `acsard lan` for this robot"
    )


def _of_ours(reason: str, host: str, directory: str) -> str:
    """Return the message for a client certificate that the server rejects.

    `reason` is OpenSSL's name of the server's TLS alert.
    """
    mine = f"{directory}/{CERTIFICATE}"
    if "CERTIFICATE_EXPIRED" in reason:
        return (
            f"{host} says that {mine} has ended or does not count yet: make a new one with `acsard "
            "lan add` where ca-key.pem is, or set the clocks of both (`timedatectl`)"
        )
    if "UNKNOWN_CA" in reason or "CERTIFICATE" in reason or "DECRYPT" in reason:
        return (
            f"{host} does not take {mine}: it is of another authority than the robot's; get one "
            "made by `acsard lan add` there"
        )
    return f"{host} does not speak TLS with us ({reason}); a plain endpoint begins with tcp/"
