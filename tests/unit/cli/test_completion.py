"""What a shell and `man` know of the command line is what the parsers know."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from acsard.cli import VERBS, main
from acsard.cli.completion import SHELLS
from acsard.host.exits import Exit

ASK = """\
source {script}
COMP_WORDS=({words}); COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 ))
{function} acsard "${{COMP_WORDS[COMP_CWORD]}}" "${{COMP_WORDS[COMP_CWORD-1]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(list(words)) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("acsard ca", {"call", "calibrate"}),
        ("acsard call cl", {"clear"}),
        ("acsard lan init --wr", {"--write"}),
        ("acsard service uninstall --pu", {"--purge"}),
    ],
)
def test_bash_offers_verbs_options_and_choices(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, offered: set[str]
) -> None:
    script = tmp_path / "acsard"
    text = printed(capsys, "completion", "bash")
    script.write_text(text)
    (function,) = {
        line.split("-F ")[1].split()[0] for line in text.splitlines() if line.startswith("complete")
    }
    ask = ASK.format(script=script, words=words, function=function)
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, timeout=30.0)
    assert set(done.stdout.split()) == offered, done


@pytest.mark.parametrize("shell", SHELLS)
def test_every_shell_knows_every_verb_and_takes_its_script(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shell: str
) -> None:
    text = printed(capsys, "completion", shell)
    names = {verb.__name__.rpartition(".")[2] for verb in VERBS}
    assert all(name in text for name in {*names, "man", "purge", "set_pose"})
    script = tmp_path / "script"
    script.write_text(text)
    if shutil.which(shell):
        subprocess.run([shell, "-n", str(script)], check=True, timeout=30.0)


def test_the_man_page_says_what_help_says(capsys: pytest.CaptureFixture[str]) -> None:
    page = printed(capsys, "man").replace("\\-", "-").replace("\\", "")
    assert page.startswith(".TH ACSARD")
    words = ("acsard service uninstall", "--purge", "acsard lan renew", "exit codes: 0 done")
    assert [word for word in words if word not in page] == []


@pytest.mark.parametrize(
    ("words", "library"),
    [(["completion", "bash"], "shtab"), (["man"], "argparse_manpage.manpage")],
)
def test_without_its_library_it_tells_what_to_type(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    library: str,
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    assert main(words) == Exit.FAILURE
    assert "pip install" in capsys.readouterr().err
