"""Shell completion and the man page list exactly the commands and options of the parsers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from acsard.cli import VERBS, main
from acsard.cli.completion import SHELLS
from acsard.host.errors import Exit
from tests.each import each
from tests.system.harness import Program, environment, until
from tests.system.terminals import Terminal
from tests.system.typed import typed

ASK = """\
source {script}
COMP_WORDS=({words}); COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 ))
{function} acsard "${{COMP_WORDS[COMP_CWORD]}}" "${{COMP_WORDS[COMP_CWORD-1]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


VALUES = [
    ("acsard get sta", {"state"}),
    ("acsard get schema/Od", {"schema/Odometry"}),
    ("acsard echo wheel_s", {"wheel_states"}),
    ("acsard echo wheel_cmd/n", {"wheel_cmd/nav"}),
    ("acsard hz json/odo", {"json/odom"}),
    ("acsard call se", {"set_pose"}),
    ("acsard set limits.linear_s", {"limits.linear_speed", "limits.linear_stop_deceleration"}),
    ("acsard set log.level war", {"warning"}),
    ("acsard set limits.linear_speed 0.8 limits.angular_sp", {"limits.angular_speed"}),
    ("acsard echo odom wheel_s", {"wheel_states"}),
    ("acsard drive --source tele", {"teleop"}),
    ("acsard sim --fault bit", {"bit_errors"}),
]
"""Pairs of typed text and all words that may complete it."""


def require(shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")


def offers(*words: str) -> list[str]:
    """Return the completions that a shell command prints, without their descriptions."""
    done = subprocess.run(words, capture_output=True, text=True, timeout=30.0)
    assert done.returncode == 0, done
    return [line.split("\t")[0] for line in done.stdout.splitlines() if line]


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the path of each shell's completion script."""
    made = {}
    for shell in SHELLS:
        ended = typed("completion", shell)
        assert ended.code == 0
        made[shell] = tmp_path_factory.mktemp(shell) / "_acsard"
        made[shell].write_text(ended.out)
    return made


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(list(words)) == 0
    return capsys.readouterr().out


@pytest.mark.slow
@each(
    ("words", "offered"),
    [
        ("acsard ca", {"call", "calibrate"}),
        ("acsard call cl", {"clear"}),
        ("acsard tls init --wr", {"--write"}),
        ("acsard service uninstall --pu", {"--purge"}),
        *VALUES,
    ],
)
def test_bash_offers_verbs_options_and_values(
    scripts: dict[str, Path], words: str, offered: set[str]
) -> None:
    script = scripts["bash"]
    (function,) = {
        line.split("-F ")[1].split()[0]
        for line in script.read_text().splitlines()
        if line.startswith("complete")
    }
    ask = ASK.format(script=script, words=words, function=function)
    assert set(offers("bash", "-c", ask)) == offered


@each(("words", "offered"), VALUES)
def test_fish_offers_the_same_values(
    scripts: dict[str, Path], words: str, offered: set[str]
) -> None:
    require("fish")
    values = offers("fish", "--no-config", "-c", f"source {scripts['fish']}; complete -C '{words}'")
    assert set(values) >= offered
    assert all(value.startswith(words.split()[-1]) for value in values)


@pytest.mark.slow
def test_zsh_completes_the_same_values_with_tab(scripts: dict[str, Path], tmp_path: Path) -> None:
    require("zsh")
    begin = (
        "PS1='> '; unsetopt zle_bracketed_paste; autoload -Uz compinit; compinit -u -D; "
        f"source {scripts['zsh']}; compdef _shtab_acsard acsard; echo rea'dy'"
    )
    with (
        Terminal() as terminal,
        Program(
            ["zsh", "-f", "-i"],
            tmp_path,
            environment(TERM="dumb"),
            stdin=terminal.slave,
            stdout=terminal.slave,
            stderr=terminal.slave,
            start_new_session=True,
        ),
    ):
        terminal.press(begin + "\r")
        until(lambda: "ready" in terminal.screen, 10.0, "zsh")
        for words, offered in VALUES:
            if len(offered) == 1:
                whole = " ".join([*words.split()[:-1], *offered])
                terminal.press(f"{words}\t")
                until(lambda: whole in terminal.screen, 10.0, whole)  # noqa: B023
                terminal.press("\x15")


@pytest.mark.parametrize("shell", ["bash", "fish"])
def test_recordings_are_offered_by_number_beside_the_files(
    scripts: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: str
) -> None:
    require(shell)
    program = tmp_path / "bin/acsard"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\necho '000041-start.mcap  2026-01-01  9 s'\necho nothing else\n")
    program.chmod(0o755)
    (tmp_path / "42.mcap").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    script, words = scripts[shell], "acsard recording show 4"
    ask = {
        "bash": ("-c", ASK.format(script=script, words=words, function="_shtab_acsard")),
        "fish": ("--no-config", "-c", f"source {script}; complete -C '{words}'"),
    }[shell]
    assert set(offers(shell, *ask)) == {"41", "42.mcap"}


@pytest.mark.parametrize("shell", SHELLS)
def test_every_shell_knows_every_verb_and_takes_its_script(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shell: str
) -> None:
    text = printed(capsys, "completion", shell)
    assert all(name in text for name in {*VERBS, "man", "purge", "set_pose"})
    script = tmp_path / "script"
    script.write_text(text)
    if shutil.which(shell):
        subprocess.run([shell, "-n", str(script)], check=True, timeout=30.0)


def test_the_man_page_contains_the_help_of_the_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    page = printed(capsys, "man").replace("\\-", "-").replace("\\", "")
    assert page.startswith(".TH ACSARD")
    words = ("acsard service uninstall", "--purge", "acsard tls renew", "exit codes: 0 done")
    assert [word for word in words if word not in page] == []


@pytest.mark.parametrize(
    ("words", "library"),
    [(["completion", "bash"], "shtab"), (["man"], "argparse_manpage.manpage")],
)
def test_without_its_library_completion_prints_the_install_command(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    library: str,
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    assert main(words) == Exit.FAILURE
    assert "pip install" in capsys.readouterr().err
