"""Static checks find no wrong command, file, link, extra or TOML on the pages.

`tests/system/test_pages.py` runs the commands, unless the page says why not.
"""

from __future__ import annotations

import ast
import re
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from acsard import cli
from acsard.core.config.settings import Config
from tests.each import each
from tests.pages import PAGES, ROOT, Block, blocks, prose, text_of

COMMANDS = list(dict.fromkeys(line for block in blocks() for line in block.commands()))

PLACEHOLDERS = {"NAME": "mute", "ROLE": "viewer", "VERB": "run", "HZ": "50"}


# commands


def test_every_block_of_commands_is_shell() -> None:
    shell = shutil.which("bash")
    if shell is None:
        pytest.skip("no bash")
    text = "\n".join(COMMANDS)
    done = subprocess.run([shell, "-n", "-c", text], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


parser = cache(cli.parser)


def calls(command: str) -> Iterator[list[str]]:
    """Return the words after each `acsard` of a command, including those inside `sh -c "..."`."""
    words = shlex.split(command)
    while words:
        end = words.index("&&") if "&&" in words else len(words)
        call, words = words[:end], words[end + 1 :]
        call = call[1:] if call[0] == "sudo" else call
        if call[:2] == ["sh", "-c"]:
            yield from calls(call[2])
        elif Path(call[0]).name == "acsard":
            ends = [call.index(sign) for sign in (">", "|") if sign in call]
            yield call[1 : min(ends, default=None)]


@each("command", [text for text in COMMANDS if "acsard" in text])
def test_a_call_of_acsard_has_the_options_it_is_given(command: str) -> None:
    for words in calls(command):
        parser().parse_args(words)


def inline() -> Iterator[tuple[str, list[str]]]:
    """Yield each command in the running text of pages: the page and the words after `acsard`."""
    for page in PAGES:
        for span in re.findall(r"`acsard\s([^`]+)`", prose(page)):
            yield page, span.split()


@each(("page", "words"), list(inline()))
def test_a_verb_in_the_text_has_the_options_named_with_it(
    page: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = [PLACEHOLDERS.get(word, word) for word in words if word not in ("…", "...")]
    verbs = [word for word in words if re.fullmatch("[a-z][a-z0-9]*", word)]
    path = verbs[: 2 if verbs[:1] in (["tls"], ["mcu"], ["service"]) else 1]
    with pytest.raises(SystemExit) as end:
        parser().parse_args([*path, "--help"])
    assert end.value.code == 0, f"{page}: acsard {' '.join(words)}"
    usage = capsys.readouterr().out
    assert not [word for word in words if word.startswith("-") and word not in usage]


# extras


def test_an_extra_is_installed_from_a_clone_and_each_one_is_named_on_a_page() -> None:
    """No index has acsard."""
    text = "".join(map(text_of, PAGES))
    named = re.findall(r"pip install (?:-e )?\s*'(\S*)\[([\w,]+)\]'", text)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {place for place, _ in named} == {"."}
    assert {extra for _, extras in named for extra in extras.split(",")} <= set(
        project["optional-dependencies"]
    )
    for extra in project["optional-dependencies"]:
        assert re.search(rf"`{extra}`|\[(\w+,)*{extra}(,\w+)*\]", text), extra


# other blocks


@each("block", blocks("sh"))
def test_a_shell_block_shows_no_prompt(block: Block) -> None:
    assert not re.search(r"^\$ ", block.text, re.M)


@each("block", blocks("toml"))
def test_lines_for_the_configuration_are_accepted(block: Block) -> None:
    for table, values in tomllib.loads(block.text).items():
        kind: Any = type(getattr(Config(), table))
        known = {field.name for field in msgspec.structs.fields(kind)}
        assert set(values) <= known
        msgspec.convert(values, kind)


@each("block", blocks("json5"))
def test_settings_for_zenoh_are_accepted(block: Block) -> None:
    zenoh.Config.from_json5(block.text)


def test_the_page_of_a_fleet_has_the_lines_of_the_robot_s_file() -> None:
    own = tomllib.loads((ROOT / "deploy/zenoh/robot.toml").read_text())
    page = "deploy/manual/pages/howto/fleet.md"
    assert own in [tomllib.loads(block.text) for block in blocks("toml") if block.page == page]


def test_the_subscribers_of_other_languages_are_those_that_are_run() -> None:
    """`tests/system/test_client_languages.py` runs these blocks with another key."""
    calls = re.findall(
        r"`(session\.declare\w+\([^`]+)`", prose("deploy/manual/pages/howto/languages.md")
    )
    sources = [
        text_of(f"deploy/clients/{file}")
        for file in ("rust/src/main.rs", "typescript/src/follow.ts")
    ]
    assert len(calls) == len(sources)
    for call, source in zip(calls, sources, strict=True):
        before, key, after = call.partition('"acsard/acsar/json/odom"')
        assert key
        assert re.search(rf"{re.escape(before)}[^()]+{re.escape(after)}", source), call


# links and files


def anchors(text: str) -> set[str]:
    """Return the link targets of headings as a code forge makes them: lower case, - for spaces."""
    titles = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@each("page", [*PAGES, "CHANGELOG.md", "SECURITY.md"])
def test_every_link_leads_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        assert path.exists(), target
        if anchor:
            assert anchor in anchors(path.read_text(encoding="utf-8")), target


def files_in(text: str) -> set[str]:
    """Return the words that are names of files or directories."""
    names = re.findall(r"(?<![\w/.<>-])((?:\.{1,2}/)?[\w.-]+/(?:[\w./-]*\w)?/?|[\w-]+\.\w+)", text)
    kinds = (".py", ".js", ".html", ".toml", ".json5", ".yaml", ".c", ".md")
    return {name for name in names if name.endswith((*kinds, "/", "acsard-stop"))}


def exists(name: str, *, below: Path) -> bool:
    return any((place / name).exists() for place in (below, ROOT))


def test_every_file_that_a_recipe_names_is_there() -> None:
    named = files_in("\n".join(re.findall(r"`([^`\s]+)`", prose("acsard/README.md"))))
    assert len(named) > 40
    assert not {name for name in named if not exists(name, below=ROOT / "acsard")}


def test_every_file_of_the_tour_is_there() -> None:
    tour = ast.get_docstring(ast.parse((ROOT / "acsard/__init__.py").read_text(encoding="utf-8")))
    assert tour is not None
    named = files_in(tour) - {"acsard/"}
    assert len(named) > 15
    assert not {name for name in named if not exists(name, below=ROOT / "acsard")}


def test_the_page_of_the_service_names_every_file_beside_it() -> None:
    page = "deploy/systemd/README.md"
    here = (ROOT / page).parent
    for cell in re.findall(r"^\| `([^`\s]+)`[^|]* \|", prose(page), re.M):
        assert sorted(here.glob(cell)), cell
    assert not {p.name for p in here.iterdir() if f"`{p.name}`" not in text_of(page)} - {
        "README.md"
    }
