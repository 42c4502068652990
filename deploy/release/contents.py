"""Says what a release contains and needs: its constraints and SBOM from the lock, its notes from
the changelog, and why it must not be published.

    python3 deploy/release/contents.py    # prints the notes of this commit's version

The build reads this file, so it uses only the standard library.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]

LOCK = ROOT / "deploy" / "systemd" / "requirements.lock"

RELEASE_LOCK = ROOT / "deploy" / "release" / "requirements.lock"

SBOM = "acsard.cdx.json"  # its name in the wheel

PLOTLY = ROOT / "acsard" / "recording" / "plotly-basic.min.js"

HOME = "Homepage"  # the only key of [project.urls]

BUILD = "# To build acsard"  # begins the second part of the lock


PIN = re.compile(
    r"^# licence(, by name)?: (.+)\n([a-z0-9-]+)==(\S+) \\\n((?: +--hash=sha256:\w+(?: \\)?\n)+)",
    re.M,
)


class Pin(NamedTuple):
    """A locked library, as `tests/tools/lock.py` writes it."""

    name: str
    version: str
    licences: list[dict[str, Any]]  # of CycloneDX
    hashes: list[str]  # SHA-256 of its wheels


def pins(lock: Path = LOCK) -> list[Pin]:
    """Return the libraries of a lock, without those that build acsard."""
    found = []
    for named, licence, name, version, hashes in PIN.findall(lock.read_text().partition(BUILD)[0]):
        names = [{"license": {"name": item}} for item in licence.split(", ")]
        licences = names if named else [{"expression": licence}]
        found.append(Pin(name, version, licences, re.findall(r"sha256:(\w+)", hashes)))
    return found


def component(name: str, version: str, licences: list[dict[str, Any]], kind: str) -> dict[str, Any]:
    """Return the component of CycloneDX; `kind` is the first word of its purl."""
    purl = f"pkg:{kind}/{name}@{version}"
    return {
        "type": "library",
        "bom-ref": purl,
        "name": name,
        "version": version,
        "licenses": licences,
        "purl": purl,
    }


def library(pin: Pin) -> dict[str, Any]:
    """Return the component of a locked library. One of its wheels is installed."""
    made = component(pin.name, pin.version, pin.licences, "pypi")
    hashes = [{"alg": "SHA-256", "content": digest} for digest in pin.hashes]
    wheels = {"type": "distribution", "url": made["purl"], "comment": "wheels", "hashes": hashes}
    return made | {"externalReferences": [wheels]}


def constraints() -> str:
    """Return constraints for pip, pipx and uv: the versions with which acsard is tested."""
    return "".join(f"{pin.name}=={pin.version}\n" for pin in pins())


def sbom(version: str) -> str:
    """Return a CycloneDX document: acsard, the code of others in it, and the locked libraries."""
    text = PLOTLY.read_bytes()
    plotly = re.search(rb"plotly\.js .* v([0-9.]+)", text[:200])
    assert plotly is not None
    bundled = component(
        "plotly.js-basic-dist-min", plotly[1].decode(), [{"license": {"id": "MIT"}}], "npm"
    )
    bundled["hashes"] = [{"alg": "SHA-256", "content": hashlib.sha256(text).hexdigest()}]
    # Its scripts and styles are in the manual, which a wheel of a release contains.
    (zensical,) = (library(pin) for pin in pins(RELEASE_LOCK) if pin.name == "zensical")
    us = f"pkg:pypi/acsard@{version.replace('+', '%2B')}"
    document: dict[str, Any] = {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "lifecycles": [{"phase": "build"}],
            "component": {
                "type": "application",
                "bom-ref": us,
                "name": "acsard",
                "version": version,
                "licenses": [{"expression": "Apache-2.0 AND MIT"}],
                "purl": us,
                "components": [bundled, zensical],
            },
        },
        "components": [library(pin) | {"scope": "required"} for pin in pins()],
    }
    if epoch := os.environ.get("SOURCE_DATE_EPOCH"):
        made = datetime.fromtimestamp(int(epoch), UTC)
        document["metadata"]["timestamp"] = made.strftime("%Y-%m-%dT%H:%M:%SZ")
    return json.dumps(document, indent=2) + "\n"


def home() -> str:
    """Return the address of the repository, "" until its owner has written it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return str(project["urls"].get(HOME, ""))


def unpublishable(ours: str, repository: str, version: str, tag: str) -> str:
    """Return why a release must not be published from a repository and a tag, "" if it may be.

    Args:
        ours: the address in `[project.urls]`.
        repository: the address of the repository that publishes.
        version: the version of its commit.
        tag: the tag that names it.
    """
    if not ours:
        return (
            f"[project.urls] in pyproject.toml has no {HOME}, so nobody has said whose release "
            f'this is; the owner of the repository writes {HOME} = "{repository}" there'
        )
    if ours != repository:
        return (
            f"[project.urls] in pyproject.toml says {ours}, and this repository is {repository}; "
            "publish from the first, or correct the address"
        )
    if f"v{version}" != tag:
        return f"the tag {tag} is of another version than the commit, {version}; tag its own commit"
    return ""


def with_absolute_links(text: str, home: str, commit: str) -> str:
    """Return a page of the repository's top for readers elsewhere: its links lead to the commit.

    Without a home the links stay as they are.
    """
    if not home:
        return text
    tree = f"{home}/blob/{commit.partition('.')[0] or 'HEAD'}/"
    text = text.replace("](#", "](README.md#")
    return re.sub(r"\]\((?!https?://)", f"]({tree}", text)


def notes(changelog: str, version: str) -> str:
    """Return the section of the changelog about a version, without its heading."""
    section = re.search(
        rf"^## {re.escape(version)} \([^\n]*\)\n+(.*?)(?=^## |\Z)", changelog, re.M | re.S
    )
    if section is None:
        raise ValueError(f"CHANGELOG.md has no section of {version}; write it before the release")
    return section[1].rstrip() + "\n"


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    from acsard import __version__
    from acsard.host.version import source

    text = notes((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), __version__)
    print(with_absolute_links(text, home(), source()), end="")  # noqa: T201
