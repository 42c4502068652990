"""Reads the content of a figure of a report, for the tests."""

from __future__ import annotations

import binascii
import struct
from typing import Any

from acsard.report.plot_elements import Figure


def column(packed: dict[str, str]) -> list[float]:
    data = binascii.a2b_base64(packed["bdata"])
    return list(struct.unpack(f"<{len(data) // 8}d", data))


def trace(figure: Figure, name: str, axis: str = "y") -> dict[str, Any]:
    (curve,) = [t for t in figure.data if t["name"] == name and t.get("yaxis", "y") == axis]
    return curve
