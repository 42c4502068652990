"""Print the effective configuration, including all defaults. If the configuration has problems,
print all of them, each with its fix, and exit with code 78.
"""

from __future__ import annotations

import argparse
import sys

import msgspec

from acsard.cli.common import add_config, load
from acsard.core.config.contradictions import warnings
from acsard.core.config.parsing import effective
from acsard.core.config.toml_text import document
from acsard.core.formatting import json_line


def add_options(parser: argparse.ArgumentParser) -> None:
    add_config(parser)
    parser.add_argument("--json", action="store_true", help="print JSON instead of TOML")


def main(args: argparse.Namespace) -> int:
    where, config = load(args.config)
    plain = effective(config)
    if args.json:
        print(json_line(msgspec.json.encode(plain).decode()))
    else:
        print(f"# effective configuration from {where}")
        print("\n".join(document(plain)))
    for text in warnings(config):
        print(f"{where}: warning: {text}", file=sys.stderr)
    return 0
