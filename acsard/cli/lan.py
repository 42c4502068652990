"""`acsard lan init | add | renew`: certificates for a bus that leaves the machine.

One authority of your own; the robot and each person or program get a certificate from it. The
robot lets in who has one, and the common name in it decides what they may do (`[access]`).
"""

from __future__ import annotations

import argparse
import os
import re
import socket
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.bus.session import CA, CERTIFICATE, KEY
from acsard.config.validation import write
from acsard.host.exits import Exit, ExitError

if TYPE_CHECKING:
    from acsard.cli.certificates import Authority

DIRECTORY = "/etc/acsard/tls"
PORT = 7449
ROLES = ("viewer", "operator", "maintainer")
MOST_DAYS = 3650
ADDRESS = re.compile(r"[A-Za-z0-9:]([A-Za-z0-9.:-]{0,251}[A-Za-z0-9:])?\Z")


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "lan",
        help="make certificates, so that other machines may join",
        description="Certificates for a bus that leaves this machine. Needs the extra: "
        "pip install 'acsard[lan]'.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    init = actions.add_parser(
        "init",
        help="an authority, the robot's certificate and one for each role",
        description="Make an authority, the robot's certificate, and one certificate for each of "
        "viewer, operator and maintainer, and print the lines of acsard.toml for them.",
    )
    init.add_argument("--force", action="store_true", help="replace what is there")
    init.add_argument(
        "--write", metavar="FILE", help="also set bus.listen and bus.tls in this acsard.toml"
    )
    init.set_defaults(main=main_init)
    more = actions.add_parser(
        "add",
        help="one more certificate",
        description="Make a certificate for one more person or program.",
    )
    more.add_argument("name", type=_name, metavar="NAME", help="its common name, e.g. laptop-anna")
    more.add_argument(
        "--role", choices=ROLES, help="what it may do; leave it out for a robot or a router"
    )
    more.set_defaults(main=main_add)
    renew = actions.add_parser(
        "renew",
        help="a new certificate for the robot, of the same authority",
        description="Make the robot's certificate anew before it ends; all others stay valid.",
    )
    renew.set_defaults(main=main_renew)
    for action in (init, more, renew):
        _add_common(action)


def _add_common(action: argparse.ArgumentParser) -> None:
    """Where the certificates are, how long they hold and for which addresses."""
    action.add_argument(
        "--directory", default=DIRECTORY, metavar="DIR", help=f"default {DIRECTORY}"
    )
    action.add_argument(
        "--days", type=_days, default=730, metavar="N", help="validity, default 730 days"
    )
    action.add_argument(
        "--address",
        action="append",
        type=_address,
        default=[],
        metavar="NAME",
        help="a name or IP address it is reached by, beside its own name; repeat it",
    )


def main_init(args: argparse.Namespace) -> int:
    """Make everything a first robot needs."""
    maker = _authority()
    directory = Path(args.directory)
    if (directory / CA).exists() and not args.force:
        raise ExitError(
            Exit.FAILURE,
            f"{directory / CA} exists: `acsard lan add` makes one more certificate with it; "
            "--force makes a new authority, and all certificates of the old one are refused then",
        )
    host = socket.gethostname()
    _writable(directory)
    authority = maker.make(directory, f"acsard at {host}", args.days)
    authority.issue(directory, "robot", _robot_names(args.address), args.days)
    for role in ROLES:
        authority.issue(directory / "clients" / role, role, [], args.days)
    if args.write:
        _configure(Path(args.write), directory.resolve())
    _admit_service(str(directory.resolve()))
    print(
        _NEXT.format(
            directory=directory.resolve(),
            port=PORT,
            host=host,
            ca=CA,
            certificate=CERTIFICATE,
            key=KEY,
        )
    )
    return 0


def main_renew(args: argparse.Namespace) -> int:
    """Replace the robot's own certificate."""
    directory = Path(args.directory)
    _writable(directory)
    _load(_authority(), directory).issue(directory, "robot", _robot_names(args.address), args.days)
    print(f"{directory / CERTIFICATE} is new; systemctl restart acsard takes it into use")
    return 0


def _robot_names(more: list[str]) -> list[str]:
    """What the robot is reached by: from elsewhere, by mDNS, and on itself."""
    host = socket.gethostname()
    return [host, f"{host}.local", "localhost", "127.0.0.1", *more]


def _load(maker: type[Authority], directory: Path) -> Authority:
    try:
        return maker.load(directory)
    except FileNotFoundError:
        raise ExitError(
            Exit.FAILURE, f"no authority in {directory}: run `acsard lan init` first"
        ) from None
    except (OSError, ValueError) as error:
        raise ExitError(Exit.FAILURE, f"cannot use the authority in {directory}: {error}") from None


def main_add(args: argparse.Namespace) -> int:
    """Make one more client certificate."""
    maker = _authority()
    directory = Path(args.directory)
    _writable(directory)
    authority = _load(maker, directory)
    place = directory / "clients" / args.name
    if place.exists():
        raise ExitError(Exit.FAILURE, f"{place} exists; remove it, or choose another name")
    named = [args.name] if ADDRESS.match(args.name) else []
    authority.issue(place, args.name, [*named, *args.address], args.days)
    if not args.role:
        print(f"{place} is for {args.name}")
        return 0
    print(f"{place} is for {args.name}; tell the robot in acsard.toml what it may do:\n")
    print(f"[access]\n{args.role}s = {write([args.role, args.name])}")
    return 0


def _admit_service(directory: str) -> None:
    """The installed unit sees loopback only and none of root's files: its drop-in mends both."""
    from acsard.cli.service import DROP_IN, UNIT, lan_drop_in, put

    if os.geteuid() != 0 or not (DROP_IN.parent.parent / UNIT).exists():
        return
    file = lan_drop_in()
    content = file.content.replace(DIRECTORY.encode(), directory.encode())
    put(type(file)(file.path, content))
    print(f"wrote {DROP_IN} for the service; look at its networks, then:")
    print("systemctl daemon-reload && systemctl restart acsard\n")


def _configure(file: Path, directory: Path) -> None:
    """Set the bus's keys in a configuration, its comments kept."""
    import tomlkit

    from acsard.config.parsing import ConfigError, parse

    try:
        before = file.read_text(encoding="utf-8") if file.exists() else ""
        parse(before.encode())
        document = tomlkit.parse(before)
        bus = document.setdefault("bus", tomlkit.table())
        listen = [str(one) for one in bus.get("listen", ["tcp/127.0.0.1:7448"])]
        if not any(one.startswith("tls/") for one in listen):
            listen.append(f"tls/0.0.0.0:{PORT}")
        bus["listen"], bus["tls"] = listen, str(directory)
        text = tomlkit.dumps(document)
        parse(text.encode())
        file.write_text(text, encoding="utf-8")
    except (OSError, ValueError, ConfigError) as error:
        raise ExitError(
            Exit.FAILURE, f"{file} is left as it was: {error}; write the lines by hand"
        ) from None
    print(f"{file}: set bus.listen = {write(listen)} and bus.tls\n")


def _name(text: str) -> str:
    good = text.isascii() and text.isprintable() and 0 < len(text) <= 64
    if not good or "/" in text or text in (".", ".."):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a name for a certificate: 1 to 64 letters, digits and signs but /"
        )
    return text


def _address(text: str) -> str:
    if not ADDRESS.match(text):
        raise argparse.ArgumentTypeError(f"{text!r} is no host name and no IP address")
    return text


def _days(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) <= MOST_DAYS:
        raise argparse.ArgumentTypeError(f"{text} is not a number of days from 1 to {MOST_DAYS}")
    return int(text)


def _writable(directory: Path) -> None:
    try:
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
    except OSError as error:
        raise ExitError(
            Exit.NO_PERMISSION, f"cannot make {directory}: {error.strerror}; use --directory"
        ) from None
    if not os.access(directory, os.W_OK):
        raise ExitError(
            Exit.NO_PERMISSION, f"cannot write to {directory}: run it by sudo, or use --directory"
        )


def _authority() -> type[Authority]:
    try:
        from acsard.cli.certificates import Authority
    except ImportError:
        raise ExitError(
            Exit.FAILURE, "needs the library cryptography; run: pip install 'acsard[lan]'"
        ) from None
    return Authority


_NEXT = """\
Wrote {directory}:
  {ca}, {certificate}, {key}   the robot's
  ca-key.pem                       the authority: whoever has it can let anyone in; keep it safe
  clients/<role>/                  one directory each for viewer, operator, maintainer

On the robot, in acsard.toml:

[bus]
listen = ["tcp/127.0.0.1:7448", "tls/0.0.0.0:{port}"]
tls = "{directory}"

Copy clients/<role>/ to who may do that, and there:

acsard echo state --connect tls/{host}.local:{port} --tls <that directory>
"""
