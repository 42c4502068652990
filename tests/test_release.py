"""A release is complete, says where it comes from, and is the same for each build of a commit."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest

from acsard import __version__
from acsard.host.version import DIRTY, full_version, source_of
from deploy.release import contents
from tests.pages import ROOT

HOME = "https://github.com/acsard/acsard"

WORKFLOWS = sorted(Path(ROOT, ".github/workflows").glob("*.yml"))


def run(*words: str | Path, cwd: Path = ROOT, env: dict[str, str] | None = None) -> str:
    done = subprocess.run(
        words, cwd=cwd, env=os.environ | (env or {}), capture_output=True, text=True
    )
    assert done.returncode == 0, f"{words}:\n{done.stdout}{done.stderr}"
    return done.stdout


def test_every_action_of_a_workflow_is_pinned_by_its_commit() -> None:
    used = [line for path in WORKFLOWS for line in re.findall(r"uses: (.*)", path.read_text())]
    assert len(used) > 10
    assert [line for line in used if not re.fullmatch(r"\S+@[0-9a-f]{40}  # v[\d.]+", line)] == []


# Two clones of the present commit, in which the same files have other times and modes

COMMIT = source_of(ROOT).removesuffix(DIRTY)
builds = pytest.mark.skipif(not COMMIT, reason="a release is made from a git clone")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    pytest.importorskip("hatch_fancy_pypi_readme", reason="only the build needs it")
    made = []
    for mask in ("022", "077"):
        clone = tmp_path_factory.mktemp("clone") / "acsard"
        run("sh", "-c", f"umask {mask} && git clone -q {ROOT} {clone}")
        out = clone.parent / "out"
        run(sys.executable, "-m", "hatchling", "build", "-d", out, cwd=clone)
        made.append(out)
    yield made
    for out in made:
        shutil.rmtree(out.parent)


def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as files:
        (name,) = (name for name in files.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(files.read(name).decode())


def files_of(wheel: Path) -> dict[str, bytes]:
    # Only the order of the files differs, and so does RECORD.
    with zipfile.ZipFile(wheel) as files:
        return {name: files.read(name) for name in files.namelist() if "/RECORD" not in name}


def the_wheel(out: Path) -> Path:
    (wheel,) = out.glob("*.whl")
    return wheel


@builds
@pytest.mark.slow
def test_two_clones_of_a_commit_give_the_same_sdist_and_wheel(built: list[Path]) -> None:
    first, second = ({path.name: path.read_bytes() for path in out.iterdir()} for out in built)
    assert sorted(first) == sorted(second)
    assert [name for name in first if first[name] != second[name]] == []
    assert len(first) == 2


@builds
@pytest.mark.slow
def test_a_wheel_of_the_sdist_has_the_files_of_the_clones_wheel_and_its_commit(
    built: list[Path], tmp_path: Path
) -> None:
    (sdist,) = built[0].glob("*.tar.gz")
    shutil.unpack_archive(sdist, tmp_path / "source")
    (source,) = (tmp_path / "source").iterdir()
    run(
        sys.executable,
        "-m",
        "hatchling",
        "build",
        "-t",
        "wheel",
        "-d",
        tmp_path / "out",
        cwd=source,
    )
    wheel = the_wheel(tmp_path / "out")
    assert files_of(wheel) == files_of(the_wheel(built[0]))
    version = full_version(__version__, COMMIT)
    assert metadata(wheel)["Version"] == version
    with zipfile.ZipFile(wheel) as files:
        assert files.read("acsard/commit").decode() == f"{COMMIT}\n"
        files.extractall(tmp_path / "installed")
    said = run(
        sys.executable, "-m", "acsard", "--version", cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "installed")},
    )  # fmt: skip
    assert said == f"acsard {version}\n"


@builds
@pytest.mark.slow
def test_each_link_of_the_wheels_readme_is_absolute_and_leads_to_a_file(built: list[Path]) -> None:
    text = metadata(the_wheel(built[0])).get_payload()
    assert isinstance(text, str)
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert len(links) > 20
    for link in links:
        assert link.startswith("https://"), link
        if path := re.match(rf"{HOME}/blob/HEAD/([^#]*)", link):
            assert Path(ROOT, path[1]).exists(), link


@builds
@pytest.mark.slow
def test_the_wheel_lists_its_libraries_and_the_code_of_others_in_it(built: list[Path]) -> None:
    with zipfile.ZipFile(the_wheel(built[0])) as files:
        (name,) = (name for name in files.namelist() if "/sboms/" in name)
        text = files.read(name).decode()
    assert name.endswith(f".dist-info/sboms/{contents.SBOM}")
    assert text == contents.sbom(full_version(__version__, COMMIT))
    for pin in contents.pins():
        assert f'"pkg:pypi/{pin.name}@{pin.version}"' in text
    assert '"pkg:npm/plotly.js-basic-dist-min@' in text
    assert '"pkg:pypi/zensical@' in text


@builds
@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_two_builds_of_a_commit_give_the_same_files(tmp_path: Path) -> None:
    for tool in ("mmdebstrap", "aarch64-linux-gnu-strip"):
        if shutil.which(tool) is None:
            pytest.skip(f"no {tool}: deploy/release/README.md names the packages to install")
    sums = []
    for number in "12":
        clone, out = tmp_path / number, tmp_path / f"out{number}"
        run("git", "clone", "-q", ROOT, clone)
        sums.append(run(clone / "deploy/release/build", "--out", out))
        assert run("sha256sum", "--check", "--quiet", "SHA256SUMS", cwd=out) == ""
        named = {line.split()[1] for line in sums[-1].splitlines()}
        assert named == {path.name for path in out.iterdir()} - {"SHA256SUMS"}
    assert sums[0] == sums[1]
    ends = [".tar.gz", ".whl", "/constraints.txt", "/acsard.cdx.json", *4 * [".deb"]]
    assert sorted(Path(name).suffix for name in named) == sorted(Path(f"a{e}").suffix for e in ends)
