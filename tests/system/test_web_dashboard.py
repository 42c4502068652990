"""A web page of another origin uses the robot's page as an interface."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from typing import Any

import aiohttp
import pytest

from acsard.certificates.authority import Authority
from tests.system.browser import NAME, Page, run
from tests.system.harness import ROOT, Bus, Daemon, finish, free_endpoint

pytestmark = pytest.mark.network

NODE = shutil.which("node")

MANUAL = ROOT / "deploy/web/README.md"


def block(language: str) -> str:
    """Return the only block of this language on the manual's page."""
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", MANUAL.read_text(), re.S | re.M)
    return str(text)


@pytest.fixture(scope="module")
def origin() -> str:
    return f"http://127.0.0.1:{free_endpoint().rpartition(':')[2]}"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, origin: str) -> Iterator[Page]:
    where = tmp_path_factory.mktemp("dashboard")
    Authority.make(where / "tls", "test", 1).issue(where / "tls", "robot", [NAME], 1)
    with (
        Daemon(where, config={"web": {"origins": [origin]}}) as daemon,
        Bus(daemon.endpoint) as bus,
    ):
        bus.linked()
        with Page(daemon, where) as server:
            yield server


def test_a_page_of_another_origin_sends_its_token_and_no_cookie(server: Page, origin: str) -> None:
    token, told = server.invite("operator", "panel"), {"Origin": origin}

    async def story() -> None:
        async with server.client() as browser:
            url = f"{server.away}/token"
            async with browser.post(url, data={"token": token}, allow_redirects=False) as answer:
                assert answer.status == 303
            for headers, status in [({}, 200), (told, 401)]:
                async with browser.get(f"{server.away}/api/state", headers=headers) as answer:
                    assert answer.status == status
            with pytest.raises(aiohttp.WSServerHandshakeError) as caught:
                await browser.ws_connect(f"{server.away}/ws", headers=told)
            assert caught.value.status == 401
            shown = {**told, "Authorization": f"Bearer {token}"}
            async with browser.get(f"{server.away}/api/state", headers=shown) as answer:
                assert answer.status == 200
            names = ("acsard", f"acsard.token.{token}")
            opening = browser.ws_connect(f"{server.away}/ws", headers=told, protocols=names)
            async with opening as opened:
                assert opened.protocol == "acsard"
                assert json.loads((await opened.receive()).data)["hello"]["role"] == "operator"
            for names in [("acsard", "acsard.token.wrong"), (f"acsard.token.{token}",)]:
                with pytest.raises(aiohttp.WSServerHandshakeError):
                    await browser.ws_connect(f"{server.away}/ws", headers=told, protocols=names)

    run(story)
    assert token not in server.stdout + server.stderr


@pytest.mark.skipif(NODE is None, reason="needs node")
def test_the_proxy_of_the_manual_makes_requests_look_like_the_page_s_own(server: Page) -> None:
    dumped = block("js") + "\nconst none = JSON.stringify;\n"
    dumped = dumped.replace("export default", "const config =") + "console.log(none(config));"
    done = finish([str(NODE), "--input-type=module", "-e", dumped], ROOT)
    assert done.code == 0, done
    proxies: dict[str, Any] = json.loads(done.out)["server"]["proxy"]
    assert set(proxies) == {"/api", "/ws"}
    assert proxies["/ws"]["ws"] is True

    async def story() -> None:
        async with aiohttp.ClientSession() as session:
            for told in proxies.values():
                assert told["changeOrigin"] is True
                written = json.dumps(told).replace("http://127.0.0.1:8080", server.here)
                headers = {"Sec-Fetch-Site": "same-origin", **json.loads(written)["headers"]}
                place = f"{server.here}/api/srv/stop"
                async with session.post(place, headers=headers) as answer:
                    assert answer.status == 200
                async with session.ws_connect(f"{server.here}/ws", headers=headers) as opened:
                    assert "hello" in (await opened.receive()).data

    run(story)
