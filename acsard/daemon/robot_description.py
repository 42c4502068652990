"""Reads the robot's URDF file (`[ros] urdf`), and explains why a file cannot be published.

The daemon publishes the text unchanged. The checks in this module find mistakes that would
otherwise appear only in the tools of ROS.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from acsard.bus.zenoh_sessions import MAX_MESSAGE_BYTES
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import String
from acsard.host.errors import Exit, ExitError

MAX_BYTES = 50_000
"""Largest size of the URDF file, bytes. It is smaller than `MAX_MESSAGE_BYTES`, because JSON needs
two bytes for each quotation mark and each line end."""

MAX_JSON_BYTES = MAX_MESSAGE_BYTES - 1024
"""Largest size of the URDF as a JSON message, bytes. The remaining 1024 bytes of
`MAX_MESSAGE_BYTES` are for the Zenoh key and Zenoh's headers."""

XACRO_TAG = "/xacro}"
"""Text that the tag of each xacro element contains. ElementTree writes the tag as
"{NAMESPACE}NAME", with a namespace such as http://www.ros.org/wiki/xacro."""

DOCUMENT_TYPE = "<!DOCTYPE"
"""Beginning of an XML document type. A URDF file with a document type is refused, because the
entities in a document type could expand to any length."""


def robot_description(path: str) -> str:
    """Return the text of the URDF file at `path`, or "" if `path` is "".

    Raises `ExitError` if the file cannot be read or published.
    """
    if not path:
        return ""
    file = Path(path)
    try:
        # The read of a pipe would never end.
        if file.exists() and not file.is_file():
            raise _error(path, "it is not a regular file; name the URDF file itself")
        with file.open("rb") as opened:
            data = opened.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise _error(
            path,
            'there is no such file; write the full path of the URDF, or set ros.urdf = "" to '
            "publish no robot description",
        ) from None
    except PermissionError:
        raise _error(
            path,
            "no permission to read it; make it readable for the user of the daemon. A service "
            "cannot read home directories: move a file from there to /etc/acsard/robot.urdf",
            Exit.NO_PERMISSION,
        ) from None
    except OSError as error:
        raise _error(path, f"it cannot be read: {error.strerror or error}") from None
    if len(data) > MAX_BYTES:
        raise _too_large(path)
    try:
        text = data.decode("utf-8-sig")
        if DOCUMENT_TYPE in text:
            raise _error(path, f"it has a document type, {DOCUMENT_TYPE} ...>; remove this tag")
        root = ET.fromstring(text)
    except UnicodeDecodeError:
        raise _error(path, "it is not UTF-8 text; save it as UTF-8") from None
    except (ET.ParseError, ValueError) as error:
        raise _error(path, f"it is not XML ({error}); name the robot's URDF") from None
    if root.tag != "robot":
        raise _error(path, f"its outermost element is <{root.tag}>, but a URDF begins with <robot>")
    if any(XACRO_TAG in element.tag for element in root.iter()):
        raise _error(
            path,
            f"it is a xacro file: convert it with `xacro {path} > robot.urdf`, and set [ros] urdf "
            "to the new file",
        )
    if len(encode(String(text), "json")) > MAX_JSON_BYTES:
        raise _too_large(path)
    return text


def _too_large(path: str) -> ExitError:
    return _error(
        path,
        f"it has more than {MAX_BYTES} bytes, or more than {MAX_JSON_BYTES} as JSON, which is too "
        "long for a message on the bus; shorten the URDF, or let robot_state_publisher publish it",
    )


def _error(path: str, why: str, code: Exit = Exit.BAD_CONFIG) -> ExitError:
    return ExitError(code, f'ros.urdf = "{path}": {why}')
