"""The HTTP interface for programs: values, services, recordings, metrics, OpenAPI document."""

from __future__ import annotations

from gzip import decompress
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
from acsard.web.reports import POLICY, Reports, State
from acsard.web.robots import Robots
from acsard.web.streams import as_json
from acsard.web.who import Who, is_loopback

READ_S = 10.0
"""Time limit for reading from a disk."""

DRAWN: dict[State, int] = {"drawing": 202, "busy": 202, "ready": 200, "failed": 503}
"""HTTP status for each state of a report."""


class TroubleError(AcsardError):
    """A request that cannot be fulfilled, with its HTTP status and an explanation."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class Programs:
    """Request handlers. The caller's identity is already verified when they run."""

    def __init__(self, robots: Robots, calls: Calls, counts: Counts, reports: Reports) -> None:
        self._robots, self._calls, self._counts = robots, calls, counts
        self._reports = reports
        self._document = msgspec.json.encode(openapi.document(__version__))

    def described(self) -> web.Response:
        """Return the OpenAPI document."""
        return web.Response(body=self._document, content_type="application/json")

    def metrics(self, viewers: int) -> web.Response:
        """Return the metrics for Prometheus."""
        robots, counts = self._robots, self._counts
        body = metrics.text(
            robots.id, robots.state, not robots.gone, viewers, counts.all(), counts.refused()
        )
        return web.Response(body=body.encode(), headers={"Content-Type": metrics.CONTENT_TYPE})

    async def settings(self, who: Who) -> web.Response:
        """Return the settings that can be changed at run time, with their present values."""
        told = await self.value(who, "config")
        assert isinstance(told.body, bytes)
        rows = settings.rows(msgspec.json.decode(told.body))
        return web.Response(body=msgspec.json.encode(rows), content_type="application/json")

    async def guide(self, who: Who, guide: Guide) -> web.Response:
        """Return the checks and calibrations that a maintainer may start."""
        if not who.may("maintainer"):
            self._counts.refuse("role", who.origin)
            raise TroubleError(403, f"checks and calibrations are for maintainers, not {who.role}")
        choices = await guide.choices(simulated=self._robots.about.simulated)
        body = msgspec.json.encode(choices)
        return web.Response(body=body, content_type="application/json")

    async def value(self, who: Who, key: str) -> web.Response:
        """Return the last value of a key as JSON. Raises `TroubleError`."""
        row = row_of(key) if openapi.PLAIN.match(key) else None
        if row is None or not openapi.asked(row):
            self._counts.refuse("path", who.origin)
            raise TroubleError(404, f"{key!r} is no key to ask for; GET /api lists them")
        if not who.may(least := least_role(key)):
            self._counts.refuse("role", who.origin)
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
        """Call a service with a JSON object as its arguments. Raises `TroubleError`."""
        try:
            given = msgspec.json.decode(body, type=dict[str, Any]) if body.strip() else {}
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            self._counts.refuse("malformed", who.origin)
            raise TroubleError(400, f"the body is to be a JSON object: {error}") from None
        robot = given.pop("robot", "")
        if not isinstance(robot, str):
            self._counts.refuse("malformed", who.origin)
            raise TroubleError(400, "robot is to be the id of another robot, which may be stopped")
        try:
            reply = await self._calls.call(who, verb, given, robot)
        except RefusedError as error:
            self._counts.refuse("role" if error.role else "path", who.origin)
            raise TroubleError(403 if error.role else 404, str(error)) from None
        status = 200 if reply.success else 409
        body = msgspec.json.encode(reply)
        return web.Response(body=body, content_type="application/json", status=status)

    async def listed(self) -> web.Response:
        """Return the list of recordings. Raises `TroubleError`."""
        place = self._place()
        try:
            rows = await in_thread(lambda: recordings.rows(place), READ_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None
        return web.Response(body=msgspec.json.encode(rows), content_type="application/json")

    async def recording(self, who: Who, name: str) -> web.StreamResponse:
        """Return a recording as a file to download. Raises `TroubleError`."""
        path, _ = await self._recorded(who, name)
        told = {"Content-Disposition": f'attachment; filename="{path.name}"'}
        return web.FileResponse(path, headers=told | {"Content-Type": "application/octet-stream"})

    async def draw(self, who: Who, name: str) -> web.Response:
        """Return the progress of a recording's report, and start drawing it if needed."""
        told = self._reports.ask(*await self._recorded(who, name))
        body = msgspec.json.encode(told)
        return web.Response(body=body, content_type="application/json", status=DRAWN[told.report])

    async def report(self, who: Who, name: str, packed: bool) -> web.Response:
        """Return a drawn report as an HTML page in a sandboxed origin. Raises `TroubleError`."""
        self._require_operator(who)
        body = self._reports.drawn(name)
        if body is None:
            self._counts.refuse("path", who.origin)
            raise TroubleError(404, f"it is not drawn: POST /api/recordings/{name}/report first")
        headers = {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Security-Policy": POLICY,
            "Vary": "Accept-Encoding",
        }
        if packed:
            return web.Response(body=body, headers=headers | {"Content-Encoding": "gzip"})
        return web.Response(body=await in_thread(lambda: decompress(body), None), headers=headers)

    async def _recorded(self, who: Who, name: str) -> tuple[Path, tuple[int, int]]:
        """Return the path and the change stamp of a recording. Raises `TroubleError`."""
        self._require_operator(who)
        place = self._place()

        def look() -> tuple[Path, tuple[int, int]] | None:
            path = recordings.named(place, name)
            return None if path is None else (path, recordings.stamp(path))

        try:
            found = await in_thread(look, READ_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None
        if found is None:
            self._counts.refuse("path", who.origin)
            raise TroubleError(404, "there is no such recording; GET /api/recordings lists them")
        return found

    def _require_operator(self, who: Who) -> None:
        if not who.may("operator"):
            self._counts.refuse("role", who.origin)
            raise TroubleError(403, f"recordings are for operators; you are {who.role}")

    def _place(self) -> Path:
        """Return the directory of the black box; raises `TroubleError`."""
        host = self._robots.endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        if not (is_loopback(host) or host == "localhost"):
            raise TroubleError(404, "the recordings are on the robot; this page's server is not")
        if not self._robots.about.recordings:
            raise TroubleError(404, "nothing is recorded: record.directory is empty")
        return Path(self._robots.about.recordings)


def _unread(place: Path, error: Exception) -> TroubleError:
    words = getattr(error, "strerror", None) or "no answer in time"
    return TroubleError(503, f"cannot read {place}: {words}")
