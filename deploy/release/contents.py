"""Says what a release contains and needs, from the lock: its constraints, and its SBOM.

The build reads this file, so it uses only the standard library.
"""

from __future__ import annotations

import json
import os
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]

LOCK = ROOT / "deploy" / "systemd" / "requirements.lock"

RELEASE_LOCK = ROOT / "deploy" / "release" / "requirements.lock"

SBOM = "acsard.cdx.json"  # its name in the wheel

PLOTLY = ROOT / "acsard" / "recording" / "plotly-basic.min.js"

RUN, BUILD = "# To run acsard", "# To build acsard"  # the two parts of the lock


class Pin(NamedTuple):
    name: str
    version: str


def pins() -> list[Pin]:
    """Return the locked libraries that acsard with the extra `tools` needs to run."""
    text = LOCK.read_text()
    run = text[text.index(RUN) : text.index(BUILD)]
    return [Pin(*found) for found in re.findall(r"^([a-z0-9-]+)==(\S+)", run, re.M)]


def constraints() -> str:
    """Return constraints for pip, pipx and uv: the versions with which acsard is tested."""
    return "".join(f"{name}=={version}\n" for name, version in pins())


def sbom(version: str) -> str:
    """Return a CycloneDX document: acsard, the code of others in it, and the locked libraries."""
    plotly = re.search(r"plotly\.js .* v([0-9.]+)", PLOTLY.read_text(encoding="utf-8")[:200])
    assert plotly is not None
    zensical = re.search(r"^zensical==(\S+)", RELEASE_LOCK.read_text(), re.M)
    assert zensical is not None
    manual = f"pkg:pypi/zensical@{zensical[1]}"
    us = f"pkg:pypi/acsard@{version.replace('+', '%2B')}"
    bundled = f"pkg:npm/plotly.js-basic-dist-min@{plotly[1]}"
    libraries: list[dict[str, Any]] = [
        {
            "type": "library",
            "bom-ref": f"pkg:pypi/{pin.name}@{pin.version}",
            "name": pin.name,
            "version": pin.version,
            "scope": "required",
            "purl": f"pkg:pypi/{pin.name}@{pin.version}",
        }
        for pin in pins()
    ]
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
                "components": [
                    {
                        "type": "library",
                        "bom-ref": bundled,
                        "name": "plotly.js-basic-dist-min",
                        "version": plotly[1],
                        "licenses": [{"license": {"id": "MIT"}}],
                        "purl": bundled,
                    },
                    # The scripts and styles of the manual, which a wheel of a release contains.
                    {
                        "type": "library",
                        "bom-ref": manual,
                        "name": "zensical",
                        "version": zensical[1],
                        "licenses": [{"license": {"id": "MIT"}}],
                        "purl": manual,
                    },
                ],
            },
        },
        "components": libraries,
    }
    if epoch := os.environ.get("SOURCE_DATE_EPOCH"):
        made = datetime.fromtimestamp(int(epoch), UTC)
        document["metadata"]["timestamp"] = made.strftime("%Y-%m-%dT%H:%M:%SZ")
    return json.dumps(document, indent=2) + "\n"
