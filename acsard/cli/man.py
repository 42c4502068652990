"""Print a man page of all subcommands and options. To install the page for yourself, write this
output to ~/.local/share/man/man1/acsard.1. Needs the library argparse-manpage; if it is missing, a
message gives the command that installs it.
"""

from __future__ import annotations

import argparse

from acsard import __version__
from acsard.cli import parser
from acsard.host.extras import missing


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare no options."""


def main(args: argparse.Namespace) -> int:
    try:
        from argparse_manpage.manpage import Manpage
    except ImportError:
        raise missing("argparse-manpage", "shell") from None
    about = {"project_name": "acsard", "version": __version__, "manual_title": "ACSAR robot"}
    print(Manpage(parser(), about))
    return 0
