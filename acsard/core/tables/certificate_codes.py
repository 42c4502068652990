"""The codes of the TLS certificates."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

CertificateCode = Literal[
    "certificate_valid", "certificate_expires", "certificate_expired", "certificate_unknown",
    "certificates_not_a_file", "certificates_open_key", "certificates_unusable",
    "certificates_refused", "certificates_not_signed", "certificates_unreadable",
]  # fmt: skip

CERTIFICATES = table(
    CertificateCode,
    """
OK certificate_valid
    {where}valid for {span}{of}
WARN certificate_expires | certificate expires
    {where}expires in {span}{of}
    -> {advice}
FAIL certificate_expired | certificate expired
    {where}expired {span} ago{of}
    -> {advice}
WARN certificate_unknown | certificate unknown
    unknown: the TLS gateway is not running, or the library that reads certificates is missing
    (`acsard doctor` says which)
    -> {advice}
FAIL certificates: not a file
    {file} is not a file
    -> {advice}
FAIL certificates: open key
    users other than the owner can read the private key {key}
    -> chmod 600 {quoted}
FAIL certificates: unusable
    {why}
    -> {advice}
FAIL certificates: refused
    Zenoh refuses {certificate} with the key {key} ({why})
    -> {advice}
WARN certificates: not signed
    {ca} has not signed {certificate}: clients that trust only this authority refuse this machine
    -> copy {names} again from the machine that has {ca_key}
WARN certificates: unreadable
    {tls}: nobody sees when they expire: the library that reads certificates is missing
    -> {advice}
""",
)
