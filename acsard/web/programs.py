"""What programs get by plain HTTP: values, services, recordings, metrics, what there is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from aiohttp import web

from acsard import __version__
from acsard.bus.access import MAY, least_role
from acsard.host.errors import MendableError, NoAnswerError
from acsard.host.threads import in_thread
from acsard.messages.encodings import DecodeError
from acsard.messages.topics import row_of
from acsard.values import AcsardError
from acsard.web import metrics, openapi, recordings, settings
from acsard.web.calls import Calls, RefusedError
from acsard.web.counts import Counts
from acsard.web.guide import Guide
from acsard.web.robots import Robots
from acsard.web.streams import as_json
from acsard.web.who import Who, is_loopback

READ_S = 10.0
"""For a disk."""


class TroubleError(AcsardError):
    """Why not: status and words."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class Programs:
    """Answers; who asks and whether he may come in at all is known by then."""

    def __init__(self, robots: Robots, calls: Calls, counts: Counts) -> None:
        self._robots, self._calls, self._counts = robots, calls, counts
        self._document = msgspec.json.encode(openapi.document(__version__))

    def described(self) -> web.Response:
        """The interface."""
        return web.Response(body=self._document, content_type="application/json")

    def metrics(self, viewers: int) -> web.Response:
        """For Prometheus."""
        robots, counts = self._robots, self._counts
        body = metrics.text(
            robots.id, robots.state, not robots.gone, viewers, counts.all(), counts.refused()
        )
        return web.Response(body=body.encode(), headers={"Content-Type": metrics.CONTENT_TYPE})

    async def settings(self, who: Who) -> web.Response:
        """What may be set, with its values now."""
        told = await self.value(who, "config")
        assert isinstance(told.body, bytes)
        rows = settings.rows(msgspec.json.decode(told.body))
        return web.Response(body=msgspec.json.encode(rows), content_type="application/json")

    async def guide(self, who: Who, guide: Guide) -> web.Response:
        """What may be begun: a check of the board, a calibration."""
        if not who.may("maintainer"):
            self._counts.refuse("role")
            raise TroubleError(403, f"checks and calibrations are for maintainers, not {who.role}")
        body = msgspec.json.encode(await guide.choices())
        return web.Response(body=body, content_type="application/json")

    async def value(self, who: Who, key: str) -> web.Response:
        """The last value of a key."""
        row = row_of(key) if openapi.PLAIN.match(key) else None
        if row is None or not openapi.asked(row):
            self._counts.refuse("path")
            raise TroubleError(404, f"{key!r} is no key to ask for; GET /api lists them")
        if not who.may(least := least_role(key)):
            self._counts.refuse("role")
            words = f"{key} is for who is {least}; you are {who.role}: {MAY[who.role]}"
            raise TroubleError(403, words)
        try:
            encoding, payload = await self._calls.get(self._robots.id, key)
        except NoAnswerError as error:
            raise TroubleError(504, str(error)) from None
        except (MendableError, DecodeError, TimeoutError) as error:
            raise TroubleError(503, str(error) or "no answer in time") from None
        return web.Response(body=as_json(encoding, payload), content_type="application/json")

    async def call(self, who: Who, verb: str, body: bytes) -> web.Response:
        """A service."""
        try:
            given = msgspec.json.decode(body, type=dict[str, Any]) if body.strip() else {}
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            self._counts.refuse("malformed")
            raise TroubleError(400, f"the body is to be a JSON object: {error}") from None
        try:
            reply = await self._calls.call(who, verb, given)
        except RefusedError as error:
            self._counts.refuse("role" if error.role else "path")
            raise TroubleError(403 if error.role else 404, str(error)) from None
        status = 200 if reply.success else 409
        body = msgspec.json.encode(reply)
        return web.Response(body=body, content_type="application/json", status=status)

    async def listed(self) -> web.Response:
        """The recordings."""
        place = self._place()
        try:
            rows = await in_thread(lambda: recordings.rows(place), READ_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None
        return web.Response(body=msgspec.json.encode(rows), content_type="application/json")

    async def recording(self, who: Who, name: str) -> web.StreamResponse:
        """One of them."""
        if not who.may("operator"):
            self._counts.refuse("role")
            raise TroubleError(403, f"recordings are for operators; you are {who.role}")
        place = self._place()
        try:
            path = await in_thread(lambda: recordings.named(place, name), READ_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None
        if path is None:
            self._counts.refuse("path")
            raise TroubleError(404, "there is no such recording; GET /api/recordings lists them")
        told = {"Content-Disposition": f'attachment; filename="{path.name}"'}
        return web.FileResponse(path, headers=told | {"Content-Type": "application/octet-stream"})

    def _place(self) -> Path:
        """The directory of the black box; raises `TroubleError`."""
        host = self._robots.endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        if not (is_loopback(host) or host == "localhost"):
            raise TroubleError(404, "the recordings are on the robot; this page's server is not")
        if not self._robots.about.recordings:
            raise TroubleError(404, "nothing is recorded: record.directory is empty")
        return Path(self._robots.about.recordings)


def _unread(place: Path, error: Exception) -> TroubleError:
    words = getattr(error, "strerror", None) or "no answer in time"
    return TroubleError(503, f"cannot read {place}: {words}")
