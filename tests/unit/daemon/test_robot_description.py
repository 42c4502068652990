"""The daemon publishes the file of `[ros] urdf` unchanged, or refuses it and names the remedy."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import pytest

from acsard.bus.zenoh_sessions import MAX_MESSAGE_BYTES
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import String
from acsard.daemon.robot_description import MAX_BYTES, robot_description
from acsard.host.errors import Exit, ExitError
from tests.each import each

ROS2 = Path(__file__).parents[3] / "deploy" / "ros2"


def refusal(path: Path | str) -> str:
    with pytest.raises(ExitError) as caught:
        robot_description(str(path))
    assert caught.value.code is Exit.BAD_CONFIG
    assert str(caught.value).startswith(f'ros.urdf = "{path}": ')
    return str(caught.value)


def written(where: Path, text: str | bytes) -> Path:
    file = where / "robot.urdf"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    return file


def test_without_a_file_the_description_is_empty() -> None:
    assert robot_description("") == ""


def test_the_robot_of_this_repository_is_published_as_it_is() -> None:
    file = ROS2 / "acsar.urdf"
    assert robot_description(str(file)) == file.read_text(encoding="utf-8")


def test_a_byte_order_mark_is_not_a_part_of_the_text(tmp_path: Path) -> None:
    assert robot_description(str(written(tmp_path, b"\xef\xbb\xbf<robot/>"))) == "<robot/>"


def test_a_missing_file_is_refused_with_both_fixes(tmp_path: Path) -> None:
    text = refusal(tmp_path / "nothing.urdf")
    assert "no such file" in text
    assert 'ros.urdf = ""' in text


def test_a_path_that_is_not_a_regular_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name in (tmp_path, tmp_path / "pipe"):
        assert "not a regular file" in refusal(name)


@each(
    ("text", "phrase"),
    [
        ("", "not XML"),
        ("robot: acsar\n", "not XML"),
        ("<robot><link></robot>", "not XML"),
        (b"<robot>\xff</robot>", "not UTF-8 text"),
        ("<sdf version='1.7'/>", "its outermost element is <sdf>"),
        (
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/>'
            "</robot>",
            "xacro",
        ),
        (
            '<robot xmlns:x="http://ros.org/wiki/xacro"><x:property name="a" value="1"/></robot>',
            "xacro",
        ),
        ('<!DOCTYPE robot [<!ENTITY a "r7">]><robot name="&a;"/>', "document type"),
        ('<?xml version="1.0"?>\n<!DOCTYPE robot SYSTEM "urdf.dtd"><robot/>', "document type"),
    ],
)
def test_a_file_that_is_not_urdf_is_refused(text: str | bytes, phrase: str, tmp_path: Path) -> None:
    assert phrase in refusal(written(tmp_path, text))


def test_a_urdf_with_only_the_xacro_namespace_is_accepted(tmp_path: Path) -> None:
    """The output of xacro is a plain URDF, but still declares the XML namespace of xacro."""
    text = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r7"/>'
    assert robot_description(str(written(tmp_path, text))) == text


@pytest.mark.slow
@each("filler", ["x", '"', "\n", "é"])
def test_the_longest_description_fits_into_a_message_of_each_encoding(
    filler: str, tmp_path: Path
) -> None:
    def text(count: int) -> str:
        return f"<robot><!--{filler * count}--></robot>"

    def fits(count: int) -> bool:
        with suppress(ExitError):
            return bool(robot_description(str(written(tmp_path, text(count)))))
        return False

    accepted = max(count for count in range(0, MAX_BYTES + 1000, 500) if fits(count))
    assert 0 < accepted < MAX_BYTES
    assert "shorten the URDF" in refusal(written(tmp_path, text(accepted + 500)))
    message = String(text(accepted))
    for form in ("json", "msgpack", "cdr"):
        assert len(encode(message, form)) < MAX_MESSAGE_BYTES - 512
