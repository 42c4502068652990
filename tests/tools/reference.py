"""Writes the generated pages of the manual's reference from the product.

`python -m tests.tools.tables` writes them, and `tests/test_tables.py` compares them.
"""

from __future__ import annotations

import argparse
import ast
import html
import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Any

from msgspec.structs import replace
from prometheus_client.parser import text_string_to_metric_families

from acsard import client
from acsard.checkup.outcomes import OUTCOMES_BY_CODE
from acsard.cli.command_line import parser
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.schema import BatterySummary
from acsard.core.messages.state_warnings import BATTERY, ESTOP
from acsard.core.ros.transports import ros_names
from acsard.core.tables.bus_codes import BUS
from acsard.core.tables.certificate_codes import CERTIFICATES
from acsard.core.tables.computer_codes import COMPUTER
from acsard.core.tables.file_codes import FILES
from acsard.core.tables.link_codes import LINK
from acsard.core.tables.message_codes import MESSAGES
from acsard.core.tables.motor_codes import MOTORS
from acsard.core.tables.pose_codes import POSE
from acsard.core.tables.sender_codes import SENDERS
from acsard.core.tables.stop_codes import STOPS
from acsard.web.app import ROUTES
from acsard.web.metrics import text as metrics_text
from tests.system.contract import matrix
from tests.unit.test_page_metrics import STATE

ROOT = Path(__file__).parents[2]

PAGES = "deploy/manual/pages/reference"

NOTE = "<!-- written by python -m tests.tools.tables -->"


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [[_cell(text) for text in row] for row in (head, *rows)]
    top, *below = (f"| {' | '.join(cells)} |\n" for cells in lines)
    return "".join((top, "|---" * len(head) + "|\n", *below))


def _cell(text: str) -> str:
    # In code of a table, a \\ before | would be shown.
    def code(match: re.Match[str]) -> str:
        return f"<code>{html.escape(match[1], quote=False).replace('|', '&#124;')}</code>"

    return re.sub(r"`([^`]*\|[^`]*)`", code, text).replace("|", "\\|")


def _page(title: str, introduction: str, *parts: str) -> str:
    return "\n".join((f"# {title}\n\n{NOTE}\n", f"{introduction}\n", *parts))


# settings


def settings() -> str:
    """Return a table for each section of `acsard.toml`."""
    parts: list[str] = []
    for section, note, rows in _sections((ROOT / "acsard.toml").read_text(encoding="utf-8")):
        if not rows:
            continue
        cells = (
            (f"`{key}`", f"`{value}`", meaning or "see the key above")
            for key, value, meaning in rows
        )
        text = f"{note}\n\n" if note else ""
        parts.append(f"## {section}\n\n{text}{table(('key', 'default', 'meaning'), cells)}")
    return _page(
        "Settings",
        "`acsard.toml` of the robot has these keys. A key that the file lacks has its default. "
        "`acsard check` prints the value\nof every key, or every mistake with its remedy. "
        "[Change a setting for good](../howto/service.md#change-a-setting-for-good) says how.",
        *parts,
    )


def _sections(text: str) -> Iterator[tuple[str, str, list[tuple[str, str, str]]]]:
    """Yield each section of the file: its name, its comment, and its keys with their comments."""
    section, note, rows = "", "", list[tuple[str, str, str]]()
    comment: list[str] = []
    for line in text.splitlines():
        if line.startswith("#"):
            comment.append(line.removeprefix("#").strip())
        elif line.startswith("["):
            if section and line.strip("[]") != section:
                yield section, note, rows
            if line.strip("[]") != section:
                section, note, rows = line.strip("[]"), " ".join(comment), []
            comment = []
        elif match := re.match(r"(\w+) = (.*?)(?:\s+#\s*(.*))?$", line):
            meaning = " ".join([*comment, *filter(None, match.groups()[2:])])
            rows.append((match[1], match[2], _literal(meaning)))
            comment = []
        elif section == "":
            comment = []
    yield section, note, rows


# types of messages


def messages() -> str:
    """Return the fields of each message type."""
    meanings = _meanings()
    parts: list[str] = []
    for name, schema in SCHEMAS.items():
        if name == "Config":
            continue
        described = {name: schema} | {
            key: value for key, value in schema["$defs"].items() if "properties" in value
        }
        for kind, fields in described.items():
            if kind != name and (kind in SCHEMAS or f"## {kind}\n" in "".join(parts)):
                continue
            rows = [
                (f"`{field}`", _kind(value), meanings.get((kind.removesuffix("In"), field), ""))
                for field, value in fields.get("properties", {}).items()
            ]
            about = _flat(fields.get("description", ""))
            width = 3 if any(meaning for _, _, meaning in rows) else 2
            head = ("field", "type", "meaning")[:width]
            body = table(head, (row[:width] for row in rows)) if rows else ""
            parts.append("\n\n".join(filter(None, (f"## {kind}", about, body))).rstrip() + "\n")
    return _page(
        "Message types",
        "A query of `schema/<Type>` returns the same as a JSON Schema. The units are SI unless a "
        "field says otherwise. A type whose\nname ends with `In` is for messages to the daemon.",
        *parts,
    )


def _meanings() -> dict[tuple[str, str], str]:
    """Return the strings below the fields of the message types, by type and field."""
    found = {}
    for module in (ROOT / "acsard/core/messages").glob("*.py"):
        for kind in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(kind, ast.ClassDef):
                for field, below in pairwise(kind.body):
                    match field, below:
                        case (
                            ast.AnnAssign(target=ast.Name(id=name)),
                            ast.Expr(value=ast.Constant(value=str(text))),
                        ):
                            found[kind.name, name] = _literal(text)
    return found


def _flat(text: str) -> str:
    return " ".join(text.split()).replace("<", "&lt;")


def _kind(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "anyOf" in schema:
        return " or ".join(map(_kind, schema["anyOf"]))
    if "enum" in schema:
        values = [f"`{value}`" for value in schema["enum"] if value != ""]
        return ", ".join(values) if len(values) <= 12 else str(schema.get("type", "string"))
    if schema.get("type") == "array":
        return f"list of {_kind(schema['items'])}" if schema.get("items") else "list"
    if schema.get("type") == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"map to {_kind(schema['additionalProperties'])}"
    return str(schema.get("type", "any"))


# command line


def commands() -> str:
    """Return the help of each subcommand."""
    return _page(
        "Command line",
        "`acsard VERB --help` prints the same text.",
        *_helps(parser(), ""),
    )


def _helps(command: argparse.ArgumentParser, path: str) -> Iterator[str]:
    yield f"## acsard{path}\n\n{_literal(command.description or '')}\n"
    subparsers = [a for a in command._actions if isinstance(a, argparse._SubParsersAction)]
    rows = []
    for action in command._actions:
        if (
            action in subparsers
            or action.help in (None, argparse.SUPPRESS)
            or action.dest == "help"
        ):
            continue
        named = " ".join(action.option_strings) or str(action.metavar or action.dest)
        value = "" if not action.option_strings or action.nargs == 0 else f" {_value(action)}"
        rows.append((f"`{named}{value}`", _literal(_help(action))))
    if rows:
        yield table(("argument", "meaning"), rows)
    if command.epilog and path:
        yield f"```text\n{command.epilog}\n```\n"
    for subparser in subparsers:
        for name, child in subparser.choices.items():
            yield from _helps(child, f"{path} {name}")


def _help(action: argparse.Action) -> str:
    """Return the help as argparse prints it, with its values filled in."""
    return (action.help or "") % {**vars(action), "prog": "acsard"}


def _value(action: argparse.Action) -> str:
    return str(action.metavar or action.dest.upper())


def _literal(text: str) -> str:
    """Return plain text as Markdown, in which < and * outside of code stay as they are."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(
        part if part.startswith("`") else re.sub(r"([*_])", r"\\\1", part).replace("<", "&lt;")
        for part in parts
    )


# the client for Python


def python_client() -> str:
    """Return the client's own description, and its methods."""
    texts = []
    for text in re.split(r"\n\n(?=\S)", inspect.cleandoc(client.__doc__ or "")):
        prose, _, code = text.partition("\n\n    ")
        texts.append(f"{_literal(prose)}\n")
        if code:
            texts.append(f"```text\n{dedent(f'    {code}')}\n```\n")
    rows = []
    for name, method in inspect.getmembers(client.Client):
        if not name.startswith("_"):
            signature = str(inspect.signature(method)) if callable(method) else ""
            call = f"{name}{signature.replace('(self, ', '(').replace('(self)', '()')}"
            about = (inspect.getdoc(method) or "").partition("\n\n")[0]
            rows.append((f"`{call.replace(chr(39), '')}`", _literal(about)))
    return _page(
        "The client for Python",
        "`python -m pydoc acsard.client` prints the same text.",
        *texts,
        "## Methods\n\n" + table(("method", "effect"), rows),
    )


# codes


def codes() -> str:
    """Return the text and the advice of each code."""
    sections = {
        "Why the robot does not move": SENDERS | STOPS,
        "Motors and wheels": MOTORS,
        "The link to the board, and its port": LINK,
        "Pose and gyro": POSE,
        "Refused messages": MESSAGES,
        "Files": FILES,
        "Certificates": CERTIFICATES,
        "The computer": COMPUTER,
        "Daemon, router and gateway": BUS,
        "Results of `acsard mcu check`": OUTCOMES_BY_CODE,
    }
    texts = []
    for title, entries in sections.items():
        rows = (
            (f"`{code}`", entry.level, _said(entry.text or entry.figure), _said(entry.advice))
            for code, entry in entries.items()
            if entry.text or entry.level != "ok"
        )
        texts += [f"## {title}\n", table(("code", "level", "text", "what to do"), rows)]
    return _page(
        "Codes and advice",
        "`code` in `state`, `sources`, `causes`, events, `diagnostics`, `acsard doctor --json` "
        "and `acsard mcu check --json` says in\none word why the robot does not move, and what "
        "went wrong. Words in capitals stand for values. Names such as mcu.port are\n[settings]"
        "(settings.md): the key `port` below `[mcu]` in `acsard.toml`, which for the service is "
        "`/etc/acsard/acsard.toml`.\n`acsard doctor` and `acsard echo state -n 1 --short` print "
        "the text of your robot. `wheel_fault` in `state` is a text, and\nstops nothing: [when a "
        "wheel fails](../explanation/wheels.md).",
        *texts,
    )


def page_findings() -> str:
    """Return what the robot's page says of each code that has a short form, for its scripts."""
    short = {
        code: (entry.figure, "" if "{" in entry.advice else entry.advice)
        for code, entry in (STOPS | MOTORS | POSE | FILES).items()
        if entry.figure and "{" not in entry.figure
    }
    rows = "".join(f"  {code}: {json.dumps(pair)},\n" for code, pair in short.items())
    return (
        "// Written by `python -m tests.tools.tables` from the tables of acsard/core/tables.\n\n"
        "/** Maps a code to its short form, and to the advice if that needs no values. */\n"
        f"export const FINDINGS = {{\n{rows}}};\n\n"
        "/** Map a level of the battery, or a state of the emergency stop, to its code. */\n"
        f"export const BATTERY = {json.dumps(BATTERY)};\n"
        f"export const ESTOP = {json.dumps(ESTOP)};\n"
    )


def _said(text: str) -> str:
    # A value that follows a word without a space is a clause that may be missing.
    always = re.sub(r"(?<=[\w)}]){\w+}", "", text)
    return _flat(re.sub(r"{(\w+)[^}]*}", lambda match: match[1].upper(), always))


# the page


def http() -> str:
    """Return the paths of the page for programs, and its metrics."""
    rows = (
        (f"`{row.method}`", f"`{row.path}`", row.least or "none needed", row.summary)
        for row in ROUTES
        if row.summary
    )
    return _page(
        "HTTP API",
        "The robot's page serves these paths to [programs](../howto/http.md); `GET /api` describes "
        "them with their types.",
        table(("method", "path", "least role", "purpose"), rows),
        "## Metrics\n\n`GET /metrics` returns these metrics. Each has the label `robot`. A metric "
        "of a value that the robot does not report\nis missing.\n",
        metrics(),
    )


def metrics() -> str:
    """Return the table of the metrics of a robot that reports everything."""
    battery = BatterySummary(volts=12.0, amps=1.0, percent=50.0, level="ok")
    state = replace(
        STATE, emergency_stop="released", bumpers=[False], battery=battery, certificate_days=1.0
    )
    text = metrics_text("acsar", "0", state, True, 1, {"x": 1}, {"x": 1}).decode()
    rows = []
    for family in text_string_to_metric_families(text):
        labels = sorted({k for s in family.samples for k in s.labels} - {"robot"})
        name = family.name + ("_total" if family.type == "counter" else "")
        rows.append(
            (f"`{name}`", ", ".join(f"`{label}`" for label in labels), family.documentation)
        )
    return table(("metric", "further labels", "meaning"), rows)


# ROS and promises


def ros() -> str:
    """Return the table of the ROS names."""
    found: dict[str, tuple[str, str, list[str]]] = {}
    for row in ros_names():
        found.setdefault(row.name, (row.direction, row.native, []))[2].append(row.type)
    rows = (
        (f"`{name}`", direction, " or ".join(types), f"`{native}`")
        for name, (direction, native, types) in found.items()
    )
    return table(("name", "direction", "type", "key of the bus"), rows)


def promises() -> str:
    """Return the contract that every program may rely on."""
    body = matrix().partition("writes this page.\n\n")[2]
    return _page(
        "Promises",
        "Every program may rely on these. A door is a way into the robot, and a test tries each "
        "promise through each door: `yes`\nholds, `-` is not offered through this door. The last "
        "column names the marks of the test.",
        body,
    )


GENERATED: dict[str, Callable[[], str]] = {
    f"{PAGES}/settings.md": settings,
    f"{PAGES}/messages.md": messages,
    f"{PAGES}/commands.md": commands,
    f"{PAGES}/python.md": python_client,
    f"{PAGES}/codes.md": codes,
    f"{PAGES}/http.md": http,
    f"{PAGES}/promises.md": promises,
    "acsard/web/page/findings.js": page_findings,
}
"""Maps each generated file to the function that writes it."""
