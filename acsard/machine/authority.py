"""Certificates and their authority as files: `ca.pem`, `certificate.pem`, `key.pem`, `ca-key.pem`.

The keys are P-256 keys, in files that only their owner can read.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from acsard.daemon.bus.tls import CA, CERTIFICATE, KEY
from acsard.machine.certificates import CA_KEY

SLACK = timedelta(hours=1)
"""Time by which a certificate is valid before its creation, because a robot's clock may be slow
when the robot starts.
"""


class Authority:
    """Certificate authority that signs certificates."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self._certificate, self._key = certificate, key

    @classmethod
    def make(cls, directory: Path, name: str, days: int) -> Authority:
        """Create an authority in `directory`, valid five times as long as its certificates."""
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name[:64])])
        certificate = (
            _builder(subject, subject, key.public_key(), 5 * days)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs=True), critical=True)
            .sign(key, hashes.SHA256())
        )
        _write(directory / CA, _pem(certificate), 0o644)
        _write(directory / CA_KEY, _key_pem(key), 0o600)
        return cls(certificate, key)

    @classmethod
    def load(cls, directory: Path, password: Callable[[], str]) -> Authority:
        """Load the authority from `directory`.

        Raises `OSError` or `ValueError` if that is impossible. `password` is called for the
        password if the key is encrypted.
        """
        data = (directory / CA_KEY).read_bytes()
        try:
            key = serialization.load_pem_private_key(data, None)
        # The key is encrypted.
        except TypeError:
            key = serialization.load_pem_private_key(data, password().encode())
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise ValueError(f"{CA_KEY} is not a P-256 key")
        return cls(x509.load_pem_x509_certificate((directory / CA).read_bytes()), key)

    def names_in(self, directory: Path) -> list[str]:
        """Return the host names and IP addresses in the certificate of `directory`, if it
        exists.
        """
        try:
            found = x509.load_pem_x509_certificate((directory / CERTIFICATE).read_bytes())
            names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except (OSError, ValueError, x509.ExtensionNotFound):
            return []
        addresses = names.get_values_for_type(x509.IPAddress)
        return [*names.get_values_for_type(x509.DNSName), *map(str, addresses)]

    def issue(self, directory: Path, name: str, addresses: list[str], days: float) -> None:
        """Write a certificate for server and client use, its key and the authority's certificate.

        `addresses` are the host names and IP addresses under which its holder is reached, and
        `days` is how long it is valid.
        """
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        names = [_general_name(address) for address in dict.fromkeys(addresses)]
        signer = self._certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier)
        builder = _builder(subject, self._certificate.subject, key.public_key(), days)
        if names:
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        certificate = (
            builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(both), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(signer.value),
                critical=False,
            )
            .sign(self._key, hashes.SHA256())
        )
        _write(directory / CA, _pem(self._certificate), 0o644)
        _write(directory / CERTIFICATE, _pem(certificate), 0o644)
        _write(directory / KEY, _key_pem(key), 0o600)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: float
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, now + timedelta(days=days)) - SLACK)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _usage(signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _write(path: Path, data: bytes, mode: int) -> None:
    """Write a new file that is never readable beyond `mode`."""
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)
