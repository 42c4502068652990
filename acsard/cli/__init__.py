"""The command line of acsard: one module for each subcommand."""

# A subcommand's module becomes a name in this one. So `set` means the builtin only elsewhere.
from acsard.cli.command_line import UNLISTED, VERBS, entry, main, parser

__all__ = ["UNLISTED", "VERBS", "entry", "main", "parser"]
