"""The fleet page's root commands and the unit for a router work in a real systemd."""

from __future__ import annotations

import pytest

from tests.pages import blocks
from tests.system.harness import ROOT, until
from tests.systemd.container import (
    ACSARD,
    CONFIG,
    HOME,
    PAGE,
    UNIT,
    UNITS,
    USUAL,
    Container,
)

pytestmark = pytest.mark.systemd

CLONE, THERE = f"{HOME}/src", "/tmp/router"

ROUTER = "acsard-router.service"

ROBOT = "robot1"

BEFORE = (
    f"cp {CLONE}/deploy/zenoh/router.json5 .",
    f"{ACSARD} tls init --directory fleet",
    f"{ACSARD} tls add router.local --directory fleet",
    "cp fleet/clients/router.local/*.pem .",
    "useradd --system zenohd",
)
"""The files that are copied to the server, and the user that zenohd's package makes."""


def test_a_router_runs_as_its_own_user_in_the_directories_that_the_page_creates(
    container: Container,
) -> None:
    (places,) = (block for block in blocks("sh") if "install -d -o zenohd" in block.text)
    container.run("mkdir", "-p", THERE)
    for command in (*BEFORE, *places.commands()):
        container.types(command, THERE)
    container.write(f"{UNITS}/{ROUTER}", (ROOT / "deploy" / "zenoh" / ROUTER).read_text())
    try:
        checked = container.run("systemd-analyze", "verify", f"{UNITS}/{ROUTER}")
        assert (checked.code, checked.out, checked.err) == (0, "", "")
        container.types("systemctl daemon-reload && systemctl start acsard-router")
        until(lambda: "router_open" in container.messages(ROUTER), 10.0, "it is open")
        shown = [container.show(name, ROUTER) for name in ("ActiveState", "User")]
        assert shown == ["active", "zenohd"]
        key = "/etc/zenohd/tls/key.pem"
        nobody = ("setpriv", "--reuid=65534", "--clear-groups")
        assert container.run(*nobody, "cat", key).code != 0
        _a_robot_and_its_page_connect(container)
    finally:
        print(container.messages(ROUTER), container.messages(UNIT), container.messages(PAGE))
        container.run("systemctl", "stop", ROUTER)
        container.run("rm", "-r", f"{UNITS}/{ROUTER}", "/etc/zenohd", "/etc/acsard/tls", THERE)
        container.reset()
        container.run("userdel", "zenohd")


def _a_robot_and_its_page_connect(container: Container) -> None:
    container.types(f"{ACSARD} tls add {ROBOT} --directory fleet", THERE)
    container.types("echo 127.0.0.1 router.local >> /etc/hosts")
    (settings,) = (block for block in blocks("toml") if f'id = "{ROBOT}"' in block.text
                   and block.page.endswith("howto/fleet.md"))  # fmt: skip
    container.write(CONFIG, f"{settings.text}\n{USUAL}")
    copied, started = (
        block for block in blocks("sh")
        if block.page.endswith("howto/fleet.md")
        and ("/etc/acsard/tls ca.pem" in block.text or "acsard.service.d" in block.text)
    )  # fmt: skip
    for block in (copied, started):
        for command in block.commands():
            container.types(command, f"{THERE}/fleet/clients/{ROBOT}")
    container.start(PAGE)  # with acsard.service, but for the links of the installation
    until(lambda: '"mode"' in container.fetch("/api/state"), 20.0, "the page shows the robot")
    assert [container.show("ActiveState", unit) for unit in (UNIT, PAGE)] == ["active"] * 2
