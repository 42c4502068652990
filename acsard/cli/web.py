"""Serve the robot's page for a running daemon until Ctrl-C. `acsard run` in a terminal starts this
by itself. A browser on the robot's machine needs no token, and has the role that the setting
web.local names. A browser on another machine needs HTTPS with the robot's certificate, and a token.
"""

from __future__ import annotations

import argparse
import asyncio
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.bus.address import address_of
from acsard.bus.zenoh_sessions import log_from_environment
from acsard.cli.common import load, whole
from acsard.cli.robot_options import add_bus
from acsard.core.config.settings import Config
from acsard.core.formatting import lasting
from acsard.core.values import ROLES
from acsard.host.errors import Exit, UsageError
from acsard.host.extras import missing
from acsard.host.logs import Log, output_in_threads
from acsard.web.callers import LOCAL_NAME

if TYPE_CHECKING:
    from acsard.web.listen import Listen
    from acsard.web.tokens import Vault

MOST_HOURS = 72

DEFAULT_DAYS = 30

NAME = re.compile(r"[A-Za-z0-9_.-]{1,32}\Z")


def add_options(parser: argparse.ArgumentParser) -> None:
    _add_place(parser, None)
    parser.add_argument("--supervised", action="store_true", help=argparse.SUPPRESS)
    actions = parser.add_subparsers(title="subcommands", metavar="SUBCOMMAND")
    invite = actions.add_parser(
        "invite",
        help="print a link with a new token, and its QR code",
        description="Print a link with a new token, and its QR code, for a browser on another "
        "machine.",
    )
    tokens = actions.add_parser(
        "tokens", help="list the tokens", description="List the tokens and how long each is valid."
    )
    revoke = actions.add_parser(
        "revoke",
        help="revoke a token",
        description="Revoke a token. The page's server disconnects the pages that use it within a "
        "second.",
    )
    _add_token(invite)
    revoke.add_argument("name", metavar="NAME", help="name of the token")
    for action, run in ((invite, main_invite), (tokens, main_tokens), (revoke, main_revoke)):
        action.set_defaults(main=run)
        _add_place(action, argparse.SUPPRESS)


def _add_place(parser: argparse.ArgumentParser, default: object) -> None:
    parser.add_argument(
        "--address",
        action="append",
        default=default,
        metavar="URL",
        help="address of the page, instead of web.address; repeat the option for several; "
        "https://0.0.0.0:8443 lets browsers on other machines connect",
    )
    add_bus(parser, default=default)


def _add_token(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("role", choices=ROLES, metavar="ROLE", help=", ".join(ROLES))
    parser.add_argument(
        "--name",
        type=_name,
        help="name of the token, for example the name of the person who gets it (default: the "
        "role)",
    )
    parser.add_argument(
        "--token",
        type=Path,
        metavar="FILE",
        help="with the role viewer: let in a program that has this token, so that one program "
        "reads many robots; the file has what `openssl rand -hex 32` prints (default: a new token, "
        "in a link)",
    )
    lasting = parser.add_mutually_exclusive_group()
    lasting.add_argument(
        "--days",
        type=whole("days", 3650, "; for less than a day use --hours"),
        metavar="N",
        help=f"days until the token expires (default: {DEFAULT_DAYS})",
    )
    lasting.add_argument(
        "--hours",
        type=whole("hours", MOST_HOURS, "; for more use --days"),
        metavar="N",
        help=f"hours until the token expires, 1 to {MOST_HOURS}, for example for a visitor",
    )


def _loaded(args: argparse.Namespace) -> tuple[str, Config]:
    try:
        import aiohttp  # noqa: F401
        import prometheus_client  # noqa: F401
        import segno  # noqa: F401
    except ImportError:
        raise missing("aiohttp, prometheus-client or segno") from None
    return load(args.config, {"bus.tls": args.tls or None})


def places(
    addresses: Sequence[Listen], listen: Sequence[Listen], tls: str, *, with_manual: bool
) -> Iterator[str]:
    """Yield a line for each URL of the page at these addresses, and one for the manual."""
    from acsard.web.listen import page_urls

    first = ""
    for address, wished in zip(addresses, listen, strict=True):
        instead = f"  (instead of {wished.url}, at which acsard cannot listen)"
        note = "" if address == wished else instead
        for url in page_urls(address, tls):
            first = first or url
            yield f"page ready  {url}{note}"
    if with_manual:
        yield f"manual      {first}docs"


def main(args: argparse.Namespace) -> int:
    _, config = _loaded(args)
    from acsard.web import page_server, tokens
    from acsard.web.manual import MANUAL

    def announce(addresses: Sequence[Listen]) -> None:
        # Write each line as one text, so that no line of the log is printed inside it.
        for line in places(addresses, listen, tls, with_manual=MANUAL.is_file()):
            sys.stdout.write(f"  {line}\n")

    tls = args.tls or config.bus.tls
    listen = _listen(args, config)
    log_from_environment()
    options = page_server.ServerOptions(
        config,
        address_of(config, args.connect, args.id, args.tls),
        listen,
        tls,
        tokens.place(),
        args.supervised,
    )
    log = Log(config.log)
    try:
        # A stopped terminal must not stop the page.
        with output_in_threads():
            asyncio.run(page_server.serve(options, announce, log))
    finally:
        log.close()
    return Exit.OK


def _listen(args: argparse.Namespace, config: Config) -> tuple[Listen, ...]:
    from acsard.web.listen import parse_listen

    return tuple(parse_listen(text) for text in args.address or config.web.address)


def main_invite(args: argparse.Namespace) -> int:
    where, config = _loaded(args)
    import segno

    from acsard.web.listen import invitations, require_certificate

    tls, listen = args.tls or config.bus.tls, _listen(args, config)
    require_certificate(listen, tls)
    urls = invitations(listen, tls)
    if not urls:
        raise UsageError(
            f"no browser could use the link: web.address in {where} has no https:// address. "
            'Either add "https://0.0.0.0:8443" to web.address, or name another file with '
            "--config, or give an https:// address with --address; `acsard tls init` makes the "
            "certificate"
        )
    vault = _vault(args, config)
    days = 0 if args.hours else args.days or DEFAULT_DAYS
    shared = _text_in(args.token) if args.token else ""
    text, token = vault.invite(args.role, args.name or args.role, days, args.hours or 0, shared)
    until = f"{_clock(token.ends)}, for {lasting(token.ends - token.made)}"
    if shared:
        print(f"{token.name} is {token.role} until {until}, with the token in {args.token}, at:\n")
        print("".join(f"  {url}\n" for url in urls))
    else:
        print(f"{token.name} is {token.role} until {until}; the link is not shown again:\n")
        print("".join(f"  {url}#token={text}\n" for url in urls))
        segno.make(f"{urls[0]}#token={text}", error="l").terminal(sys.stdout, compact=True)
        print()
    print(f"to revoke the token before that: acsard web revoke {token.name}")
    if unknown := vault.unknown_to():
        print(unknown)
    return Exit.OK


def _text_in(file: Path) -> str:
    try:
        return file.read_text(errors="replace").strip()
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror}") from None


def _vault(args: argparse.Namespace, config: Config) -> Vault:
    from acsard.web.tokens import Vault, place

    return Vault(place(), address_of(config, args.connect, args.id, args.tls).robot_id)


def main_revoke(args: argparse.Namespace) -> int:
    _vault(args, _loaded(args)[1]).revoke(args.name)
    print(f"{args.name} is revoked")
    return Exit.OK


def main_tokens(args: argparse.Namespace) -> int:
    # Do not import this at the top. The server of the page never prints a table, and the import
    # would use 5 MB of memory while the server runs.
    from acsard.terminal.output import show, table

    vault = _vault(args, _loaded(args)[1])
    tokens, now_s = vault.all(), vault.now_s()

    def until(ends: int) -> str:
        left = f"{lasting(60 * round((ends - now_s) / 60))} left" if ends > now_s else "ended"
        return f"until {_clock(ends)}, {left}"

    if tokens:
        show(table((token.name, token.role, until(token.ends)) for token in tokens))
    else:
        print(
            f"no tokens for the robot {vault.robot} are in {vault.path}; `acsard web invite "
            "ROLE` makes one"
        )
    return Exit.OK


def _clock(seconds: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def _name(text: str) -> str:
    if not NAME.match(text):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a name: use 1 to 32 characters of A-Z a-z 0-9 _ . -"
        )
    if text == LOCAL_NAME:
        raise argparse.ArgumentTypeError(
            f"{text!r} is the name of each browser on the robot itself; choose another name, so "
            "that the log shows who called a service"
        )
    return text
