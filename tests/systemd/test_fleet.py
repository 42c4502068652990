"""The fleet page's root commands for a router work in a real systemd."""

from __future__ import annotations

import pytest

from tests.pages import blocks
from tests.system.harness import until
from tests.systemd.container import ACSARD, HOME, Container

pytestmark = pytest.mark.systemd

CLONE, THERE = f"{HOME}/src", "/tmp/router"

BEFORE = (
    f"cp {CLONE}/deploy/zenoh/router.json5 .",
    f"{ACSARD} tls init --directory fleet",
    f"{ACSARD} tls add router.local --directory fleet",
    "cp fleet/clients/router.local/*.pem .",
    "useradd --system zenohd",
)
"""The files that are copied to the server, and the user that zenohd's package makes."""


@pytest.mark.nightly
def test_a_router_runs_as_its_own_user_in_the_directories_that_the_page_creates(
    container: Container,
) -> None:
    (places,) = (block for block in blocks("sh") if "install -d -o zenohd" in block.text)
    container.run("mkdir", "-p", THERE)
    for command in (*BEFORE, *places.commands()):
        container.types(command, THERE)
    key = "/etc/zenohd/tls/key.pem"
    assert container.run("setpriv", "--reuid=65534", "--clear-groups", "cat", key).code != 0
    router = (ACSARD, "router", "/etc/zenohd/router.json5")
    container.run("systemd-run", "--unit=router", "--uid=zenohd", *router)
    try:
        until(lambda: "router_open" in container.messages("router"), 10.0, "it is open")
    finally:
        container.run("systemctl", "stop", "router")
