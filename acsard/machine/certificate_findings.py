"""Examines the certificates of this machine, and those of the routers to which it connects."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from acsard.bus.certificate_watch import router_expiry_times
from acsard.bus.tls_files import (
    AUTHORITY,
    CA,
    CERTIFICATE,
    KEY,
    common_name,
    expiry_times,
    files_in,
    host_and_port,
    require_usable,
)
from acsard.bus.zenoh_sessions import certificate_trouble
from acsard.core.config.settings import Config
from acsard.core.messages.certificate_expiry import expiry, first_expiry
from acsard.host.clock import now
from acsard.host.errors import MendableError
from acsard.host.extras import install
from acsard.machine.certificates import CA_KEY, ROBOT_NAME
from acsard.machine.finding import Finding, about, finding


def certificates(tls: str) -> Iterator[Finding]:
    """Yield findings about this machine's certificates, if there are any."""
    if not tls:
        return
    directory = Path(tls)
    for file in files_in(tls):
        if os.path.exists(file) and not os.path.isfile(file):  # reading it might never end
            yield finding("certificates_not_a_file", file=file, advice=_mend_of_absent(directory))
            return
    key, own = directory / KEY, directory / CERTIFICATE
    if os.path.isfile(key) and key.stat().st_mode & 0o077:
        yield finding("certificates_open_key", key=key, quoted=shlex.quote(str(key)))
    try:
        require_usable(tls)
    except MendableError as error:
        yield finding("certificates_unusable", why=error, advice=_mend_of_absent(directory))
        return
    if why := certificate_trouble(*files_in(tls)):
        advice = renewal(tls, "")
        yield finding("certificates_refused", certificate=own, key=key, why=why, advice=advice)
        return
    if not common_name(tls):  # which a connection shows that trusts only the authority
        yield finding(
            "certificates_not_signed",
            ca=directory / CA,
            certificate=own,
            names=f"{CA}, {CERTIFICATE} and {KEY}",
            ca_key=CA_KEY,
        )
        return
    expiries = expiry_times(tls)
    if not expiries:
        yield finding("certificates_unreadable", tls=tls, advice=install())
        return
    mend = renewal(tls, first_expiry(expiries)[0])
    yield about("certificates", expiry(expiries, now().wall_ns, mend, f"{tls}: "))


def renewal(tls: str, whose: str) -> str:
    """Return how to replace a certificate that expires soon: "" is this machine's own.

    `whose` may also be `AUTHORITY` or a text such as "the router tls/HOST:PORT".
    """
    directory, name = Path(tls), common_name(tls)
    if whose == AUTHORITY:
        return (
            f"on the machine that has {CA_KEY}, in the directory of that file, run `acsard tls "
            "init --force --directory .`; then make a new certificate for each client, and copy it "
            "to that client"
        )
    if not whose and name == ROBOT_NAME:
        there = (
            ""
            if os.path.exists(directory / CA_KEY)
            else f", after you have copied {CA_KEY} into that directory"
        )
        return f"run `{_command('renew', directory)}`{there}"
    to = tls
    if whose:
        name, to = host_and_port(whose.rpartition(" ")[2])[0], "the router"
    return (
        f"on the machine that has {CA_KEY}, in the directory of that file, run `acsard tls renew "
        f"--name {shlex.quote(name)} --directory .`; then copy clients/{name}/*.pem from there to "
        f"{to}"
    )


def _mend_of_absent(directory: Path) -> str:
    try:
        has_authority = (directory / CA_KEY).exists()
        is_empty = not directory.is_dir() or not any(directory.iterdir())
    except PermissionError:
        return f"run this check again with sudo: this user may not look into {directory}"
    if has_authority:
        return f"run `{_command('renew', directory)}`, or run this check again with sudo"
    if is_empty:
        return (
            f"run `{_command('init', directory)}`, or copy the files that `acsard tls add` made "
            "into that directory"
        )
    return (
        f"either run this check with sudo, or go to the machine that has {CA_KEY} and copy {CA}, "
        f"{CERTIFICATE} and {KEY} from there into this directory again"
    )


def _command(action: str, directory: Path) -> str:
    places = (directory, *directory.absolute().parents)
    # In contrast to `Path.exists`, this raises no error if this user may not enter a directory.
    there = next(place for place in places if os.path.exists(place))
    program = "acsard"
    if not os.access(there, os.W_OK):
        # sudo does not search this user's PATH, so the command contains the full path of acsard.
        path = shutil.which("acsard")
        program = f"sudo {path or f'{sys.executable} -m acsard'}"
    return f"{program} tls {action} --directory {shlex.quote(str(directory))}"


def router_certificates(config: Config) -> Iterator[Finding]:
    """Yield a finding about the certificate of each TLS router in `bus.connect` that answers."""
    tls = config.bus.tls
    for whose, ends_ns in router_expiry_times(config.bus.tls_routers, tls).items():
        yield about("router", expiry({whose: ends_ns}, now().wall_ns, renewal(tls, whose)))
