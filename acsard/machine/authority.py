"""Creates the certificate authority of a robot, and the certificates that the authority signs.

Keys are P-256, in files that only their owner can read. Users make their phones trust the
authority, so its certificate limits the hosts: a thief of its key can pose as a robot or as a host
of a private network, but not as a web site on the Internet.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from acsard.bus.tls_files import CA, CERTIFICATE, KEY
from acsard.host.atomic_file import replace
from acsard.host.errors import MendableError, NotPermittedError
from acsard.machine.certificates import CA_KEY

# An authority may sign for these, and for all names below them.
LOCAL_NAMES = ("local", "localhost")

# No host on the Internet has such an address.
PRIVATE_NETWORKS = (
    "10.0.0.0/8", "100.64.0.0/10", "127.0.0.0/8", "169.254.0.0/16", "172.16.0.0/12",
    "192.168.0.0/16", "::1/128", "fc00::/7", "fe80::/10",
)  # fmt: skip

Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class Authority:
    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self._certificate, self._key = certificate, key

    @classmethod
    def make(
        cls, directory: Path, name: str, days: int, addresses: Sequence[str] = ()
    ) -> Authority:
        """Create an authority in `directory`, for certificates with any common name (of a client).

        `days` is the validity of its certificates; its own is five times as long. It may also sign
        for `addresses`: host names with all below them, and IPv6 addresses with their /64 network.
        """
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name[:64])])
        certificate = (
            _builder(subject, subject, key.public_key(), 5 * days)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs=True), critical=True)
            .add_extension(_constraints(addresses), critical=True)
            .sign(key, hashes.SHA256())
        )
        _write(
            {directory / CA_KEY: (_key_pem(key), 0o600), directory / CA: (_pem(certificate), 0o644)}
        )
        return cls(certificate, key)

    @classmethod
    def load(cls, directory: Path) -> Authority:
        """Load the authority.

        Raises `OSError` or `ValueError`, also for one that has expired, and `TypeError` if its key
        is encrypted.
        """
        key = serialization.load_pem_private_key((directory / CA_KEY).read_bytes(), None)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise ValueError(f"{CA_KEY} is not a P-256 key")
        certificate = x509.load_pem_x509_certificate((directory / CA).read_bytes())
        if certificate.public_key() != key.public_key():
            raise ValueError(f"{CA_KEY} is the key of another authority than {CA}")
        end = certificate.not_valid_after_utc
        if end <= datetime.now(UTC):
            raise ValueError(
                f"it expired on {end:%Y-%m-%d}; `acsard tls init --force` makes a new one, and "
                "then every client needs a new certificate"
            )
        return cls(certificate, key)

    def permits(self, address: str) -> bool:
        """Return whether the authority may sign for a host name or IP address.

        An authority of another program may have no limits. All are permitted then.
        """
        try:
            limits = self._certificate.extensions.get_extension_for_class(x509.NameConstraints)
        except x509.ExtensionNotFound:
            return True
        return any(_within(address, name) for name in limits.value.permitted_subtrees or ())

    def names_in(self, directory: Path) -> list[str]:
        """Return the host names and IP addresses in the certificate in `directory`."""
        try:
            certificate = x509.load_pem_x509_certificate((directory / CERTIFICATE).read_bytes())
            names = certificate.extensions.get_extension_for_class(
                x509.SubjectAlternativeName
            ).value
        except (OSError, ValueError, x509.ExtensionNotFound):
            return []
        addresses = names.get_values_for_type(x509.IPAddress)
        return [*names.get_values_for_type(x509.DNSName), *map(str, addresses)]

    def issue(self, directory: Path, name: str, addresses: list[str], days: float) -> None:
        """Create a key and a certificate for server and client, beside the authority's."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        names = [_general_name(address) for address in dict.fromkeys(addresses)]
        builder = _builder(subject, self._certificate.subject, key.public_key(), days)
        if names:
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        certificate = (
            builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(both), critical=False)
            .add_extension(self._identifier(), critical=False)
            .sign(self._key, hashes.SHA256())
        )
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        _write(
            {
                directory / CA: (_pem(self._certificate), 0o644),
                directory / CERTIFICATE: (_pem(certificate), 0o644),
                directory / KEY: (_key_pem(key), 0o600),
            }
        )

    def _identifier(self) -> x509.AuthorityKeyIdentifier:
        try:
            own = self._certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier)
        except x509.ExtensionNotFound:
            # Another program has made this authority.
            return x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        return x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(own.value)


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
        # The validity begins an hour ago, because the clock of a robot may be behind at its start.
        .not_valid_before(min(now, now + timedelta(days=days)) - timedelta(hours=1))
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


def _constraints(addresses: Sequence[str]) -> x509.NameConstraints:
    hosts, networks = list(LOCAL_NAMES), [ipaddress.ip_network(item) for item in PRIVATE_NETWORKS]
    for address in addresses:
        named = _general_name(address)
        if not isinstance(named, x509.IPAddress):
            hosts.append(address.lower())
        elif not any(named.value in item for item in networks):
            networks.append(_network_of(address))
    # A host name below another permitted name needs no separate entry.
    own = [item for item in dict.fromkeys(hosts) if not any(item.endswith(f".{h}") for h in hosts)]
    return x509.NameConstraints([*map(x509.DNSName, own), *map(x509.IPAddress, networks)], None)


def _network_of(address: str) -> Network:
    # The IPv6 address of a host changes within its /64 network.
    length = 64 if ":" in address else 32
    return ipaddress.ip_network((address, length), strict=False)


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _within(address: str, permitted: x509.GeneralName) -> bool:
    name = _general_name(address)
    if isinstance(permitted, x509.IPAddress):
        is_address = isinstance(name, x509.IPAddress)
        return is_address and name.value in ipaddress.ip_network(str(permitted.value))
    return f".{address.lower()}".endswith(f".{permitted.value}")


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _write(files: Mapping[Path, tuple[bytes, int]]) -> None:
    # Never with more permissions than the mode. Raises `MendableError` or `NotPermittedError`.
    try:
        for path, (data, mode) in files.items():
            replace(path, data, mode=mode, owner=(os.geteuid(), os.getegid()))
    except OSError as error:
        kind = NotPermittedError if isinstance(error, PermissionError) else MendableError
        raise kind(
            f"cannot write {path}: {error.strerror}; the key and its certificate belong together, "
            "so remove the cause and run the command again"
        ) from None
