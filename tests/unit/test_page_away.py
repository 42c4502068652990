"""The page for a client on another machine: its token, its cookie, its role and its limits."""

from __future__ import annotations

import io
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any, cast
from unittest.mock import AsyncMock

import aiohttp
import msgspec
import pytest
from msgspec.structs import replace
from yarl import URL

from acsard.client.connection import Connection
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, LogConfig
from acsard.core.messages.schema import ServiceReply
from acsard.core.throttle import Rate
from acsard.host.logs import Log
from acsard.machine.authority import Authority
from acsard.web import access
from acsard.web.callers import cookie_name
from acsard.web.connections import MAX_OF_TOKEN
from acsard.web.page_server import Certificate
from tests.unit.test_page_whole import Whole


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    where = tmp_path_factory.mktemp("tls")
    Authority.make(where, "test", 1).issue(where, "robot", ["192.168.0.1"], 1)
    return Certificate(str(where), Log(LogConfig(), io.StringIO()))


class Away:
    """A page with a token of each role, and a client on another machine."""

    def __init__(self, whole: Whole, url: URL, session: aiohttp.ClientSession) -> None:
        self.whole, self.url, self.session = whole, url, session
        self.texts = {role: self.invited(role) for role in ("viewer", "operator", "maintainer")}

    def invited(self, role: Any, name: str = "") -> str:
        text, _ = self.whole.vault.invite(role, name or role, 1)
        self.whole.tokens.read()
        return text

    async def ask(self, what: str, role: str = "", **how: Any) -> tuple[int, Any]:
        """Send a request with the token of a role, and return the status and the JSON."""
        method, path = what.split()
        bearer = {"Authorization": f"Bearer {self.texts.get(role, role)}"} if role else {}
        headers = bearer | how.pop("headers", {})
        request = self.session.request(method, self.url / path, headers=headers, **how)
        async with request as answer:
            return answer.status, msgspec.json.decode(await answer.read() or b"null")


@asynccontextmanager
async def opened(where: Path, certificate: Certificate) -> AsyncIterator[Away]:
    whole = Whole(where)
    whole.tokens.next_reading = AsyncMock()  # type: ignore[method-assign]
    async with whole.served(certificate) as (url, session):
        yield Away(whole, url, session)


async def test_each_request_needs_a_valid_token_of_a_sufficient_role(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path, certificate) as away:
        for what, role, status, words in (
            ("GET api/whoami", "viewer", 200, ""),
            ("GET api/whoami", "", 401, "run `acsard web invite ROLE` on the robot"),
            ("GET api/whoami", "x" * 43, 401, "expired, revoked, or for another robot"),
            ("GET api/config", "operator", 403, "GET /api/config is for maintainers"),
            ("POST api/srv/clear", "viewer", 403, "your role is viewer"),
            ("POST api/srv/stop", "", 401, "a token is missing"),
            ("GET api", "viewer", 200, ""),
        ):
            found, body = await away.ask(what, role)
            assert (found, words in body.get("error", "")) == (status, True), (what, role)
        assert (await away.ask("GET api/whoami", "operator"))[1]["role"] == "operator"
        async with away.session.get(away.url / "favicon.ico") as answer:
            assert (answer.status, answer.content_type) == (200, "image/svg+xml")
        assert away.whole.counts.refused() == {"no_token": 2, "bad_token": 1, "role": 2}


async def test_a_token_that_is_newer_than_the_last_reading_is_waited_for(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path, certificate) as away:
        text, _ = away.whole.vault.invite("viewer", "tv", 1)

        async def read() -> None:
            away.whole.tokens.read()

        away.whole.tokens.next_reading = read  # type: ignore[method-assign]
        assert (await away.ask("GET api/whoami", text))[0] == 200


async def test_a_link_of_a_lower_role_replaces_a_cookie_only_if_asked_to(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path, certificate) as away:
        name = cookie_name("acsar", away.url.port or 0)
        own = {"Origin": "https://robot.local"}

        async def sign_in(role: str, had: str = "", **more: bool) -> tuple[int, Any, Any]:
            cookies = {"Cookie": f"{name}={away.texts[had]}"} if had else {}
            form = {"token": away.texts[role]} | more
            request = away.session.post(
                away.url / "token", json=form, headers=own | cookies, allow_redirects=False
            )
            async with request as answer:
                return answer.status, answer.cookies.get(name), answer.headers.get("Location")

        status, cookie, location = await sign_in("operator")
        assert (status, cookie.value, location) == (303, away.texts["operator"], "/")
        flags = cookie["secure"], cookie["httponly"], cookie["samesite"], cookie["path"]
        assert flags == (True, True, "Strict", "/")
        assert 86_000 < int(cookie["max-age"]) <= 86_400
        assert (await sign_in("viewer", had="operator"))[:2] == (409, None)
        assert (await sign_in("viewer", had="operator", replace=True))[0] == 303
        assert (await sign_in("operator", had="operator"))[0] == 303
        assert (await sign_in("maintainer", had="operator"))[0] == 303
        away.whole.vault.revoke("operator")
        away.whole.tokens.read()
        assert (await sign_in("viewer", had="operator"))[0] == 303
        # The cookie is a token of the robot's own page.
        cookies = {"Cookie": f"{name}={away.texts['viewer']}"}
        for origin, status in (
            (own, 409),  # there is no robot to stop
            ({"Origin": "https://evil.example"}, 403),
        ):
            assert (await away.ask("POST api/srv/stop", headers=cookies | origin))[0] == status


async def test_over_plain_http_no_token_is_needed(tmp_path: Path) -> None:
    whole = Whole(tmp_path)
    async with whole.served() as (url, session):
        own = {"Origin": str(url.origin())}
        async with session.post(url / "token", json={"token": "x"}, headers=own) as answer:
            assert answer.status == 403
            assert "no token is needed" in (await answer.json())["error"]


async def test_a_token_that_makes_too_many_requests_loses_its_other_connections(
    tmp_path: Path, certificate: Certificate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "REQUEST_RATE", Rate(0.001, 3))
    async with opened(tmp_path, certificate) as away:
        bearer = {"Authorization": f"Bearer {away.texts['viewer']}"}
        async with away.session.ws_connect(away.url / "ws", headers=bearer) as theirs:
            statuses = [(await away.ask("GET api/whoami", "viewer"))[0] for _ in range(3)]
            assert statuses == [200, 200, 429]
            while (message := await theirs.receive()).type != aiohttp.WSMsgType.CLOSE:
                pass
            assert message.data == aiohttp.WSCloseCode.POLICY_VIOLATION
        # A stop is answered beyond the limit, and another token has its own.
        assert (await away.ask("POST api/srv/stop", "viewer"))[0] == 409
        assert (await away.ask("GET api/whoami", "operator"))[0] == 200
        assert away.whole.counts.refused() == {"too_fast": 1}


async def test_a_token_has_a_limited_number_of_websockets_and_a_stop_needs_none(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path, certificate) as away, AsyncExitStack() as stack:
        bearer = {"Authorization": f"Bearer {away.texts['viewer']}"}
        for _ in range(MAX_OF_TOKEN):
            await stack.enter_async_context(
                away.session.ws_connect(away.url / "ws", headers=bearer)
            )
        status, body = await away.ask("GET api/whoami", "viewer")
        assert (status, "8 connections with this token" in body["error"]) == (503, True)
        assert (await away.ask("POST api/srv/stop", "viewer"))[0] == 409
        assert (await away.ask("GET api/whoami", "operator"))[0] == 200


async def test_a_websocket_ends_with_the_reason_when_its_token_is_revoked(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path, certificate) as away:
        bearer = {"Authorization": f"Bearer {away.texts['viewer']}"}
        async with away.session.ws_connect(away.url / "ws", headers=bearer) as theirs:
            away.whole.page.tidy()
            assert "hello" in await theirs.receive_json()
            away.whole.vault.revoke("viewer")
            away.whole.tokens.read()
            away.whole.page.tidy()
            while (message := await theirs.receive()).type != aiohttp.WSMsgType.CLOSE:
                pass
            assert message.extra == "your token has expired or was revoked: ask for a new one"


async def test_a_script_of_another_page_offers_its_token_beside_the_subprotocol(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path, certificate) as away:
        token = f"acsard.token.{away.texts['viewer']}"
        async with away.session.ws_connect(away.url / "ws", protocols=["acsard", token]) as theirs:
            assert theirs.protocol == "acsard"
        with pytest.raises(aiohttp.WSServerHandshakeError, match="400"):
            await away.session.ws_connect(away.url / "ws", protocols=[token])


class Daemon:
    """The connection to a daemon, which answers queries and calls."""

    name = ""

    def named(self, name: str) -> Daemon:
        return self

    def reply(self, key: str) -> tuple[str, bytes]:
        known = {"config": msgspec.json.encode(effective(Config())), "odom": b'{"x":1}'}
        return "application/json", known[key.partition("?")[0]]

    def request(self, verb: str, payload: object) -> ServiceReply:
        return ServiceReply(verb != "clear", verb)


async def test_values_settings_and_calls_are_those_of_the_daemon(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path, certificate) as away:
        away.whole.robot.client = cast(Connection, Daemon())
        assert await away.ask("GET api/odom", "viewer") == (200, {"x": 1})
        status, rows = await away.ask("GET api/settings", "maintainer")
        assert (status, "limits.linear_speed" in {row["key"] for row in rows}) == (200, True)
        for verb, status in (("stop", 200), ("activate", 200), ("clear", 409)):
            found, body = await away.ask(f"POST api/srv/{verb}", "maintainer", json={})
            assert (found, body["success"], body["message"]) == (status, status == 200, verb)
        away.whole.robot._about_due_s = 1.0
        await away.ask("POST api/srv/set", "maintainer", json={"settings": {}})
        assert away.whole.robot._about_due_s == 0.0, "the limits may be others now"


async def test_a_recording_is_downloaded_by_its_name(
    tmp_path: Path, certificate: Certificate
) -> None:
    async with opened(tmp_path / "state", certificate) as away:
        away.whole.robot.about = replace(away.whole.robot.about, recordings=str(tmp_path))
        name = "000001-20261121T070027Z.rec.zst"
        (tmp_path / name).write_bytes(b"recorded")
        status, rows = await away.ask("GET api/recordings", "viewer")
        assert (status, [row["name"] for row in rows]) == (200, [name])
        bearer = {"Authorization": f"Bearer {away.texts['maintainer']}"}
        async with away.session.get(away.url / "api/recordings" / name, headers=bearer) as answer:
            assert await answer.read() == b"recorded"
            assert answer.content_type == "application/octet-stream"
            assert name in answer.headers["Content-Disposition"]
        assert (await away.ask("GET api/recordings/2", "maintainer"))[0] == 404
        assert (await away.ask(f"GET api/recordings/{name}", "viewer"))[0] == 403
