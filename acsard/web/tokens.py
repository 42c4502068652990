"""Creates, stores and checks the access tokens of clients on other machines.

The token file contains the SHA-256 hash of each token, and not the token itself. A token has 32
random bytes, so nobody can compute a token from its hash.
"""

from __future__ import annotations

import asyncio
import fcntl
import hashlib
import math
import os
import re
import secrets
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import asdict

from acsard.core.values import ROLES, Role
from acsard.host import clock
from acsard.host.atomic_file import replace
from acsard.host.errors import MSGSPEC_ERRORS, MendableError, NotPermittedError, UsageError
from acsard.web.callers import AdmittedClient

FILE = "tokens.json"

# State directory of the service `acsard-web`.
SERVICE_DIRECTORY = Path("/var/lib/acsard-web")

# Of the time in the token file: more writes would wear out an SD card.
TIME_PERIOD_S = 60

# At least as long as 32 random bytes in base64. Nothing can see whether a text is random.
_TEXT = re.compile(r"[A-Za-z0-9_-]{43,128}")


class Token(Struct, frozen=True):
    """The stored record of a token."""

    name: str
    role: str  # admits nobody if only a later version knows it
    digest: str
    made: int  # s since 1970
    ends: int  # s since 1970
    robot: str  # whose page it opens


class _File(Struct, frozen=True):
    tokens: list[dict[str, Any]]  # a record that is not a valid `Token` is kept and admits nobody
    newest: int = 0  # the newest time that a server or an invitation has seen, s since 1970


class Vault:
    """The access tokens of one robot. The token file also contains tokens of other robots.

    The clock of a robot without a battery may begin in 1970 at each start. So the file contains the
    newest time that was seen, and a token expires by the later of the clock and this time, which
    goes on while the server runs.
    """

    def __init__(self, directory: Path, robot: str) -> None:
        self.path, self.robot = directory / FILE, robot
        self._newest_s = math.inf  # of the file; without a file no time is stored
        self._offset_s = -math.inf  # from the steady clock to the newest time

    def now_s(self) -> float:
        """Return the later of the clock and the newest time at the last reading of the file, s."""
        return max(time.time(), clock.steady_s() + self._offset_s)

    def all(self) -> list[Token]:
        """Return this robot's tokens, also expired ones; [] if the file cannot be read."""
        try:
            return self._own(self._load()[1].tokens)
        except (OSError, *MSGSPEC_ERRORS):
            return []

    def valid(self) -> list[Token]:
        """Return the tokens that are valid now, and store the time in the file if that is due."""
        tokens, now_s = self.all(), self.now_s()
        if now_s >= self._newest_s + TIME_PERIOD_S:
            # Without room on the disk, the tokens expire by the clock alone.
            with suppress(MendableError, NotPermittedError, UsageError), self._changing():
                pass
        return [token for token in tokens if token.ends > now_s]

    def unknown_to(self, service: Path = SERVICE_DIRECTORY) -> str:
        """Return a warning if the service `acsard-web` reads another token file, else ""."""
        if self.path.parent == service or not os.path.lexists(service):
            return ""
        return (
            f"this token is in {self.path}, a file that the service acsard-web on this machine "
            "does not read: to invite users to the page of that service, run this command with sudo"
        )

    def invite(
        self, role: Role, name: str, days: int, hours: int = 0, text: str = ""
    ) -> tuple[str, Token]:
        """Create a token, and return its text, which is stored nowhere, and its record.

        `text` is that of a viewer's token which several robots share; without it the token gets a
        new one. Raises `UsageError` for a name or a text in use, for a shared token of another
        role, because whoever finds it could drive every robot, and for a text of another form.
        """
        if text and role != "viewer":
            raise UsageError(
                f"--token is for the role viewer, not for the role {role}: many robots may share "
                "such a token, and whoever finds it could drive them all. Leave out --token: then "
                "each robot makes a token of its own"
            )
        if text and not _TEXT.fullmatch(text):
            raise UsageError(
                "a token has 43 to 128 characters of A-Z a-z 0-9 _ and -, at random: make one with "
                "`openssl rand -hex 32`"
            )
        with self._changing() as rows:
            now_s = int(self.now_s())
            if any(record.name == name for record in self._own(rows)):
                raise UsageError(
                    f"the token {name} exists already: either give another --name, or revoke the "
                    f"old token with `acsard web revoke {name}`"
                )
            text = text or secrets.token_urlsafe(32)
            if used := [one.name for one in self._own(rows) if one.digest == _digest(text)]:
                raise UsageError(
                    f"this token is on the robot already, as {used[0]}: revoke that one first with "
                    f"`acsard web revoke {used[0]}`"
                )
            ends = now_s + 3600 * (24 * days + hours)
            token = Token(name, role, _digest(text), now_s, ends, self.robot)
            rows.append(asdict(token))
        return text, token

    def revoke(self, name: str) -> None:
        """Delete the robot's token with this name. Raises `UsageError` if there is none."""
        with self._changing() as rows:
            ours = self._own(rows)
            if all(token.name != name for token in ours):
                known = ", ".join(token.name for token in ours) or "none"
                raise UsageError(
                    f"there is no token {name} of {self.robot} in {self.path}; the robot's tokens: "
                    f"{known}"
                )
            rows[:] = [
                row
                for row in rows
                if (token := _token(row)) is None or (token.name, token.robot) != (name, self.robot)
            ]

    def _own(self, rows: list[dict[str, Any]]) -> list[Token]:
        tokens = (_token(row) for row in rows)
        return [token for token in tokens if token is not None and token.robot == self.robot]

    def _load(self) -> tuple[dict[str, Any], _File]:
        # Fields that only a later version knows are written back.
        raw = msgspec.json.decode(self.path.read_bytes(), type=dict[str, Any])
        file = msgspec.convert(raw, _File)
        self._newest_s = file.newest
        self._offset_s = max(self._offset_s, file.newest - clock.steady_s())
        return raw, file

    @contextmanager
    def _changing(self) -> Iterator[list[dict[str, Any]]]:
        # Locks the file, deletes the expired tokens, and writes the file after the `with` block.
        directory = self.path.parent
        try:
            directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX)
                try:
                    raw, file = self._load()
                except FileNotFoundError:
                    raw, file = {}, _File([])
                now_s = self.now_s()
                rows = [row for row in file.tokens if not _has_expired(row, now_s)]
                yield rows
                self._write(raw | {"tokens": rows, "newest": int(now_s)})
            finally:
                os.close(handle)
        except PermissionError:
            raise NotPermittedError(
                f"no permission to write {self.path}: run this command with sudo"
            ) from None
        except OSError as error:
            raise MendableError(f"cannot write {self.path}: {error.strerror}") from None
        except MSGSPEC_ERRORS as error:
            raise UsageError(
                f"{self.path} does not hold tokens as this version writes them ({error}): "
                "correct it, or move it away and invite all users again"
            ) from None

    def _write(self, content: dict[str, Any]) -> None:
        # If root writes the file, give it to the directory's owner, because the service reads it as
        # its own user.
        directory = self.path.parent.stat()
        owner = (directory.st_uid, directory.st_gid) if os.geteuid() == 0 else None
        replace(self.path, msgspec.json.encode(content), mode=0o600, owner=owner)


def place() -> Path:
    """Return the directory of the token file: for the service and for root that of the service."""
    if "STATE_DIRECTORY" in os.environ:
        return Path(os.environ["STATE_DIRECTORY"].partition(":")[0])
    if os.geteuid() == 0 and SERVICE_DIRECTORY.is_dir():
        return SERVICE_DIRECTORY
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "acsard-web"


class ReadTokens:
    """The tokens that were valid at the last reading of the file, for a server.

    `read` runs in a thread, because a disk may not answer. Until it does, a token is valid if it
    was valid before, and has not expired since.
    """

    def __init__(self, vault: Vault) -> None:
        self._vault = vault
        self._known: dict[str, Token] = {}
        self._news = asyncio.Event()

    def read(self) -> None:
        self._known = {token.digest: token for token in self._vault.valid()}

    def announce(self) -> None:
        """Wake the callers of `next_reading`. Call this in the event loop after `read`."""
        self._news.set()
        self._news.clear()

    async def next_reading(self) -> None:
        """Wait until the file has been read again, but at most 2 s."""
        with suppress(TimeoutError):
            async with asyncio.timeout(2.0):
                await self._news.wait()

    def owner(self, texts: Iterable[str]) -> AdmittedClient | None:
        """Return the owner of the first valid token, or None."""
        for digest in map(_digest, texts):
            token = self._known.get(digest)
            if token is not None and self.left_s(digest):
                role = next((role for role in ROLES if role == token.role), None)
                return role and AdmittedClient(role, token.name, digest)
        return None

    def left_s(self, digest: str) -> int:
        """Return the time until a token expires; 0 if it is not valid."""
        token = self._known.get(digest)
        return 0 if token is None else max(0, math.ceil(token.ends - self._vault.now_s()))


def _token(row: dict[str, Any]) -> Token | None:
    try:
        return msgspec.convert(row, Token)
    except msgspec.ValidationError:
        return None


def _has_expired(row: dict[str, Any], now_s: float) -> bool:
    token = _token(row)
    return token is not None and token.ends <= now_s


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()
