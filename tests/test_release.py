"""A release is complete, says where it comes from, and is the same for each build of a commit."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest

from acsard import __version__
from acsard.host.version import DIRTY, full_version, source_of
from deploy.release import contents
from tests.each import each
from tests.pages import ROOT

HOME = "https://forge.test/owner/name"

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


@each(
    ("said", "tag", "why"),
    [
        ("", f"v{__version__}", "has no Homepage"),
        ("https://forge.test/other", f"v{__version__}", "says https://forge.test/other"),
        (HOME, "v9.9.9", "the tag v9.9.9 is of another version"),
        (HOME, f"v{__version__}", ""),
    ],
)
def test_only_the_owners_repository_publishes_the_version_of_its_tag(
    said: str, tag: str, why: str
) -> None:
    found = contents.unpublishable(said, HOME, __version__, tag)
    assert why in found if why else not found


@pytest.mark.skipif(bool(contents.home()), reason="the owner has named the home of the project")
def test_a_build_to_publish_is_refused_until_the_owner_has_named_the_home(tmp_path: Path) -> None:
    build, out = ROOT / "deploy/release/build", str(tmp_path / "out")
    words = [sys.executable, str(build), "--publish", HOME, f"v{__version__}", "--out", out]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "build: [project.urls] in pyproject.toml has no Homepage" in done.stderr
    assert not (tmp_path / "out").exists()


def test_nothing_but_pyproject_toml_names_a_home_of_the_project() -> None:
    """One line has it, so no other file can have an address that the owner did not give."""
    home = re.compile(r"https?://[^\s\"')>]*/acsard(?:/acsard)?(?:[/\s\"')>]|$)")
    files = [path for path in ROOT.rglob("*") if path.suffix in (".md", ".yml", ".toml", ".py")]
    files = [path for path in files if not {".venv", ".git"} & set(path.parts)]
    assert len(files) > 500
    found = {path for path in files if home.search(path.read_text(encoding="utf-8"))}
    assert found <= {ROOT / "pyproject.toml"}


def test_links_of_a_page_lead_to_its_commit_once_there_is_a_home() -> None:
    page = "[a](SECURITY.md#reports), [b](#start), [c](https://zenoh.io)"
    assert contents.with_absolute_links(page, "", "1a2b") == page
    tree = f"{HOME}/blob/1a2b/"
    assert contents.with_absolute_links(page, HOME, "1a2b.dirty") == (
        f"[a]({tree}SECURITY.md#reports), [b]({tree}README.md#start), [c](https://zenoh.io)"
    )


def test_the_notes_of_a_release_are_its_section_of_the_changelog() -> None:
    text = "# Changelog\n\n## 0.3.0 (2026-12-24)\n\nNew.\n\n## 0.2.0 (2026-11-30)\n\nFirst.\n"
    assert contents.notes(text, "0.3.0") == "New.\n"
    assert contents.notes(text, "0.2.0") == "First.\n"
    with pytest.raises(ValueError, match=r"no section of 0\.2"):
        contents.notes(text, "0.2")
    assert contents.notes(Path(ROOT, "CHANGELOG.md").read_text(), __version__.partition(".dev")[0])


def test_each_library_of_the_sbom_has_its_licence_and_the_hashes_of_its_wheels() -> None:
    document = json.loads(contents.sbom("0.2.0+1"))
    components = document["components"] + document["metadata"]["component"]["components"]
    assert len(components) > 25
    for item in components:
        assert item["licenses"], item["name"]
        (wheels,) = item.get("externalReferences", [item])
        assert all(re.fullmatch("[0-9a-f]{64}", one["content"]) for one in wheels["hashes"])
        assert wheels["hashes"], item["name"]
    names = {item["name"]: item["licenses"] for item in components}
    assert names["aiohttp"] == [{"expression": "Apache-2.0 AND MIT"}]
    assert {"license": {"name": "Apache Software License"}} in names["eclipse-zenoh"]


def test_an_updater_raises_what_is_pinned_to_one_version() -> None:
    project = tomllib.loads(Path(ROOT, "pyproject.toml").read_text())["project"]
    linters = project["optional-dependencies"]["lint"]
    updater = Path(ROOT, ".github/dependabot.yml").read_text()
    assert all("==" in linter for linter in linters)
    assert {linter.split("==")[0] for linter in linters} == set(
        re.findall(r"- dependency-name: (\S+)", updater)
    )
    assert "package-ecosystem: github-actions" in updater


def test_a_release_is_on_the_index_after_all_else_is_there() -> None:
    """The index keeps a file for ever."""
    text = Path(ROOT, ".github/workflows/release.yml").read_text()
    needs = re.findall(r"^  (\w+):\n    needs: (\w+)$", text, re.M)
    assert needs == [("files", "build"), ("publish", "files")]


# Two clones of the present commit, in which the same files have other times and modes

COMMIT = source_of(ROOT).removesuffix(DIRTY)
builds = pytest.mark.skipif(not COMMIT, reason="a release is made from a git clone")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    pytest.importorskip("hatchling", reason="only the build needs it")
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
def test_the_wheels_readme_is_that_of_the_commit(built: list[Path]) -> None:
    text = metadata(the_wheel(built[0])).get_payload()
    page = Path(ROOT, "README.md").read_text()
    assert text == contents.with_absolute_links(page, contents.home(), COMMIT)
    assert metadata(the_wheel(built[0]))["Description-Content-Type"] == "text/markdown"


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
    ends = [".tar.gz", ".whl", "/constraints.txt", "/acsard.cdx.json", *6 * [".deb"]]
    assert sorted(Path(name).suffix for name in named) == sorted(Path(f"a{e}").suffix for e in ends)
