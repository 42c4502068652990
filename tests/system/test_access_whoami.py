"""Every tool finds its role by the access rules, and names it when the role lacks a permission."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from acsard.client import connect
from acsard.core.values import ROLES
from tests.system.harness import (
    Bus,
    until,
)
from tests.system.identities import Gated, Identity

pytestmark = pytest.mark.network


VIEWER_MAY = "this role may read data and stop the robot, but not drive it"


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gated]:
    robot = Gated(tmp_path_factory.mktemp("whoami"))
    with robot.daemon, Bus(robot.plain) as bus:
        bus.linked()
        until(lambda: robot.tool("viewer", "get", "info").code == 0, 10.0, "the gateway")
        yield robot


@pytest.mark.parametrize("role", ROLES)
def test_whoami_returns_the_role_and_name_of_each_certificate(robot: Gated, role: Identity) -> None:
    with connect(robot.tls, tls=robot.own(role)) as client:
        us = client.whoami()
        assert (us.role, us.certificate, us.sender) == (role, role, client._connection.sender)


def test_doctor_prints_the_role_the_certificate_and_its_permissions(robot: Gated) -> None:
    output = robot.tool("viewer", "doctor").out
    assert f"role: your certificate viewer has the role viewer: {VIEWER_MAY}" in output
    assert re.search(r"; your sender id is \S+@\S+ acsard doctor/[0-9a-f]{16}", output)


@pytest.mark.parametrize(
    ("words", "least"),
    [
        (("call", "clear"), "operator"),
        (("call", "set_pose", "0", "0", "0"), "maintainer"),
        (("get", "config"), "maintainer"),
    ],
    ids=["clear", "set_pose", "config"],
)
def test_a_request_that_a_viewer_may_not_make_is_refused_with_the_role_it_needs(
    robot: Gated, words: tuple[str, ...], least: str
) -> None:
    ended = robot.tool("viewer", *words)
    assert (ended.code, ended.out) == (77, "")
    assert "certificate viewer has the role viewer" in ended.err
    assert f"needs at least the role {least}" in ended.err
