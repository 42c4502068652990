"""Print the effective configuration, including all defaults. If the configuration has problems,
print all of them, each with its fix, and exit with code 78. The files of bus.tls are checked, too.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import msgspec

from acsard.bus.tls_files import name_warnings, require_usable
from acsard.cli.common import add_config, load
from acsard.core.config.contradictions import warnings
from acsard.core.config.parsing import effective
from acsard.core.config.toml_text import document
from acsard.core.formatting import json_line, many
from acsard.host.errors import MendableError, NotPermittedError
from acsard.machine.certificate_findings import certificates
from acsard.machine.deploy_files import reference, source

STDOUT = 1


def add_options(parser: argparse.ArgumentParser) -> None:
    add_config(parser)
    parser.add_argument("--json", action="store_true", help="print JSON instead of TOML")
    parser.add_argument(
        "--new", type=Path, metavar="FILE",
        help="only write a new FILE: all settings with their defaults and explanations",
    )  # fmt: skip


def main(args: argparse.Namespace) -> int:
    if args.new:
        return _write_new(args.new)
    where, config = load(args.config)
    _require_other_output(where)
    found, bus = warnings(config) + name_warnings(config), config.bus
    if bus.uses_tls:
        try:
            require_usable(bus.tls)
        except NotPermittedError as error:
            found.append(f"the certificates were not checked: {error}")
        else:
            found += _about_certificates(bus.tls)
    plain = effective(config)
    if args.json:
        print(json_line(msgspec.json.encode(plain).decode()))
    else:
        print(f"# effective configuration from {where}")
        print("\n".join(document(plain)))
    for text in found:
        print(f"{where}: warning: {text}", file=sys.stderr)
    print(f"{where}: no mistakes, {many(len(found), 'warning')}", file=sys.stderr)
    return 0


def _about_certificates(tls: str) -> list[str]:
    # Returns warnings. Raises `MendableError` for what TLS would refuse.
    findings = [finding for finding in certificates(tls) if finding.mend]
    if findings and findings[0].level == "failure":
        raise MendableError(f"{findings[0].text}; {findings[0].mend}")
    return [f"{finding.text}; {finding.mend}" for finding in findings]


def _write_new(file: Path) -> int:
    text = reference(source()).read_bytes()
    try:
        with file.open("xb") as new:
            new.write(text)
    except FileExistsError:
        raise MendableError(
            f"{file} exists already, and was not changed: edit it, or name another file"
        ) from None
    except OSError as error:
        raise MendableError(f"cannot write {file}: {error.strerror}") from None
    print(f"{file} has all settings with their defaults")
    return 0


def _require_other_output(where: str) -> None:
    # The shell has emptied FILE before `acsard check > FILE` reads it: only defaults are left.
    try:
        same = os.path.samestat(os.stat(where), os.fstat(STDOUT))
    except OSError:  # the built-in defaults have no file
        return
    if same:
        raise MendableError(
            f"the output goes into {where}, which acsard reads: the shell empties the file of `>` "
            "before acsard starts. Restore its settings; `acsard check --new FILE` makes a new file"
        )
