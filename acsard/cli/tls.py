"""Make certificates for a bus that other machines can reach, and the configuration of a fleet's
router. Needs the extra `tools`.
"""

from __future__ import annotations

import argparse
import ipaddress
import os
import re
import socket
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from acsard.bus.address import require_id
from acsard.bus.tls_files import CA, CERTIFICATE, KEY
from acsard.cli.common import add_config, load, whole
from acsard.core.config.settings import Config
from acsard.core.config.validation import write
from acsard.core.values import ROLES
from acsard.host.config_file import change, require_changeable, require_tomlkit
from acsard.host.errors import UsageError
from acsard.machine import certificates
from acsard.machine import service_installation as service
from acsard.machine.deploy_files import source
from acsard.machine.router_file import router_file
from acsard.machine.service_installation import TLS_DIRECTORY

NAME = re.compile(r"(?!@)[A-Za-z0-9_ .:@+-]{1,64}")


def add_options(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(title="actions", required=True)
    init = actions.add_parser(
        "init",
        help="make a certificate authority, the robot's certificate and a client certificate for "
        "each role",
        description="Make a certificate authority, the robot's certificate, and one certificate "
        "each for viewer, operator and maintainer. Print the lines to write into acsard.toml, so "
        "that the robot uses the certificates.",
    )
    init.add_argument("--force", action="store_true", help="overwrite existing files")
    init.add_argument(
        "--write",
        type=Path,
        metavar="FILE",
        help="also set bus.listen and bus.tls in this acsard.toml",
    )
    init.set_defaults(main=main_init)
    more = actions.add_parser(
        "add",
        help="make one more certificate",
        description="Make a certificate for one more person or program.",
    )
    more.add_argument(
        "name",
        type=_name,
        metavar="NAME",
        help="common name of the new certificate, e.g. laptop",
    )
    more.add_argument(
        "--role",
        choices=ROLES,
        help="role of the certificate; leave this option out for a robot or a router",
    )
    more.add_argument(
        "--write",
        type=Path,
        metavar="FILE",
        help="also add NAME to the list of its role in the table [access] of this acsard.toml",
    )
    add_config(more)
    more.set_defaults(main=main_add)
    renew = actions.add_parser(
        "renew",
        help="replace a certificate that expires soon with a new one from the same authority",
        description="Replace the robot's certificate before it expires. With --name, replace "
        "another certificate, which `tls add` made. The new certificate has the names and "
        "addresses of the old certificate. All other certificates stay valid.",
    )
    renew.add_argument(
        "--name",
        type=_name,
        metavar="NAME",
        help="renew the certificate in the subdirectory clients/NAME, for example the certificate "
        "of robot4 in a fleet (default: the robot's own certificate)",
    )
    renew.set_defaults(main=main_renew)
    for action in (init, more, renew):
        _add_common(action)
    _add_router(actions)


def _add_router(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    router = actions.add_parser(
        "router",
        help="print the configuration of a fleet's router",
        description="Print router.json5 for `acsard router` or zenohd. This file says what each "
        "robot and each person's certificate may do. The steps to set up the router are in "
        "page howto/fleet of the manual.",
    )
    router.add_argument("robots", nargs="+", metavar="ROBOT", help="ids of the robots")
    for role in ROLES:
        router.add_argument(
            f"--{role}",
            action="append",
            type=_name,
            default=[],
            metavar="NAME",
            help=f"name of one more certificate with the role {role}; a certificate named {role} "
            "always has it. Repeat the option for several names",
        )
    router.set_defaults(main=main_router)


def _add_common(action: argparse.ArgumentParser) -> None:
    action.add_argument(
        "--directory",
        type=Path,
        default=Path(TLS_DIRECTORY),
        metavar="DIR",
        help=f"default {TLS_DIRECTORY}",
    )
    action.add_argument(
        "--days",
        type=whole("days", 3650),
        default=730,
        metavar="N",
        help="validity in days (default: 730)",
    )
    action.add_argument(
        "--address",
        action="append",
        type=_address,
        default=[],
        metavar="NAME",
        help="one more host name or IP address for the certificate, for example another name of "
        "the robot; repeat the option for several",
    )


def main_init(args: argparse.Namespace) -> int:
    # `Path.resolve` of Python 3.11 raises a RuntimeError for a loop of links. `init` explains it.
    directory = Path(os.path.realpath(args.directory))

    configs: list[Config] = []

    def keys(config: Config) -> dict[str, object]:
        configs.append(config)
        return certificates.keys(config, directory)

    if args.write:
        require_tomlkit()
        require_changeable(args.write, keys, new=True)
    else:
        # Set bus.tls in this call, because the file may already contain https:// or tls/ addresses.
        # Without bus.tls, such addresses are not valid.
        wanted: Mapping[str, object] = keys(load(None, {"bus.tls": str(directory)})[1])
    names = certificates.init(args.directory, args.address, args.days, force=args.force)
    if args.write:
        wanted = change(args.write, keys, new=True)
        print(f"{args.write} now has bus.listen = {write(wanted['bus.listen'])} and bus.tls\n")
    _admit_service(directory)
    host, robot = socket.gethostname(), configs[-1].robot.id
    files = {"ca": CA, "certificate": CERTIFICATE, "key": KEY}
    listen = write(wanted["bus.listen"])
    lines = "" if args.write else _LINES.format(listen=listen, directory=directory)
    print(_certified(names))
    where = f"tls/{host}.local:{certificates.port(configs[-1])}"
    print(_NEXT.format(directory=directory, robot=robot, where=where, lines=lines, **files))
    return 0


def main_add(args: argparse.Namespace) -> int:
    listed = f"{args.role}s"

    def keys(config: Config) -> dict[str, object]:
        there = getattr(config.access, listed)
        return {f"access.{listed}": list(dict.fromkeys([*there, args.name]))}

    # Load the configuration before any file is written, so that an error leaves no files.
    where, config = load(args.config)
    if args.write:
        if not args.role:
            raise UsageError(
                "--write adds the name to the list of a role, but no role was given: add, for "
                "example, --role operator"
            )
        require_tomlkit()
        require_changeable(args.write, keys, new=True)
    place = certificates.add(args.directory, args.name, args.address, args.days)
    if not args.role:
        print(f"{place} is for {args.name}")
        return 0
    if args.write:
        names = write(change(args.write, keys, new=True)[f"access.{listed}"])
        print(f"give {place} to {args.name}; {args.write} now contains access.{listed} = {names}")
    else:
        names = write(keys(config)[f"access.{listed}"])
        print(_ADDED.format(place=place, name=args.name, where=where))
        print(f"[access]\n{listed} = {names}\n")
    print(
        "The daemon reads the roles of certificates only when it starts: run `systemctl restart "
        "acsard`, or restart `acsard run`"
    )
    return 0


def main_renew(args: argparse.Namespace) -> int:
    if args.name:
        place = certificates.renew_client(args.directory, args.name, args.address, args.days)
        files = ", ".join((CA, CERTIFICATE, KEY))
        print(f"{place} has a new certificate. Copy {files} from there over the old files.\n")
        print(_RENEWED_CLIENT)
        return 0
    print(_certified(certificates.renew(args.directory, args.address, args.days)))
    print(f"{args.directory / CERTIFICATE} is the new certificate.\n\n{_RENEWED_ROBOT}")
    return 0


def main_router(args: argparse.Namespace) -> int:
    for robot in args.robots:
        require_id(robot)
    template = (source() / "zenoh" / "router.json5").read_text()
    people = {role: getattr(args, role) for role in ROLES}
    print(router_file(template, args.robots, people), end="")
    return 0


def _certified(names: list[str]) -> str:
    return f"The robot's certificate is valid for {', '.join(names)} (--address adds names).\n"


def _admit_service(directory: Path) -> None:
    # The TLS gateway of an installed service may then use them.
    step = service.admitting(directory)
    if step is None:
        return
    step.do()
    print(
        f"{step}\nThis file lists the networks that may reach the TLS gateway."
        " Check the list, then run:"
    )
    print("systemctl daemon-reload && systemctl restart acsard\n")


def _name(text: str) -> str:
    # The names in the table [access] of acsard.toml follow the same rule, because a name becomes a
    # part of keys on the bus. Here the name also becomes the name of a directory.
    if not NAME.fullmatch(text) or text in (".", ".."):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a name for a certificate: 1 to 64 letters, digits, spaces and "
            "_.:@+-, and no @ at the start"
        )
    return text


def _address(text: str) -> str:
    with suppress(ValueError):
        ipaddress.ip_address(text)
        return text
    # The last part of a host name is never a number, so such a text is a mistyped address.
    mistyped = ":" in text or text.rpartition(".")[2].isdigit() or ".." in text
    if mistyped or not certificates.ADDRESS.match(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a host name or an IP address")
    return text


_ADDED = """\
{place} is for {name}. Add the name to the list of its role in [access] of the robot's acsard.toml,
and keep the names that are already in the list. The lines below include the names in {where}. With
--write FILE, this command changes the file for you. If the robot connects to a fleet's router,
leave the lines out, because router.json5 has the roles.
"""

_RENEWED_ROBOT = """\
`acsard web` and the gateway of `acsard run` use the new certificate within 5 s by themselves. For
this, the gateway disconnects its clients for about a second: a robot that one of them drives ramps
to zero. If you started `acsard gateway` by hand, it ends with code 1: start it again.

A systemd service has copies of the files. Renew them on the robot; it keeps driving meanwhile:

  sudo systemctl try-reload-or-restart acsard-gateway acsard-web
"""

_RENEWED_CLIENT = """\
A tool uses the new certificate when it starts next.
A robot that connects to a router uses it for its next connection. For a service type there
`sudo systemctl reload acsard`; the robot keeps driving.
`acsard router` and `zenohd` keep the old certificate until you restart them:
`sudo systemctl restart acsard-router`; driven robots ramp to zero.
"""

_LINES = """\
For a fleet go on with `acsard tls add` (page howto/fleet of the manual). For one robot write into
acsard.toml there (--write FILE does this for you):

[bus]
listen = {listen}
tls = "{directory}"

"""

_NEXT = """\
Wrote {directory}:
  {ca}, {certificate}, {key}   the robot's files
  ca-key.pem                       the authority's key: a person who has it can admit anyone.
                                   Move it off the robot; `tls add` and `tls renew` need it
  clients/<role>/                  one directory each for viewer, operator, maintainer

{lines}The daemon reads bus.listen and bus.tls only when it starts: run
`systemctl restart acsard`, or restart `acsard run`.

Copy clients/<role>/ to the machine of each person with that role, and run there:

acsard echo state --id {robot} --connect {where} --tls <that directory>

From Python: connect("{where}", robot_id="{robot}", tls="<that directory>")
"""
