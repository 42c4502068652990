"""A stand-in for the Foxglove server, which records the status messages that viewers would see."""

from __future__ import annotations


class Server:
    """The recorded status messages: the text of each message, or the id of a withdrawn message."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def publish_status(self, text: str, level: object, status_id: str | None) -> None:
        self.shown.append(text)

    def remove_status(self, ids: list[str]) -> None:
        self.shown += [f"without {status_id}" for status_id in ids]

    def publish_parameter_values(self, values: object) -> None:
        pass
