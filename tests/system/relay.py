"""A TCP relay between a client and the daemon, in which bytes wait or are lost."""

from __future__ import annotations

import queue
import socket
import threading
import time
from contextlib import suppress


class Relay:
    """A TCP relay to the daemon. Its methods may be called from any thread."""

    def __init__(self, endpoint: str) -> None:
        self.seconds = 0.0
        """How long each byte of the client waits."""
        self.open = threading.Event()
        """Clear in a partition: then all bytes, and new connections, wait until it heals."""
        self.open.set()
        self._target = ("127.0.0.1", int(endpoint.rpartition(":")[2]))
        self._server = socket.create_server(("127.0.0.1", 0))
        self._sockets: list[socket.socket] = []
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"

    def __enter__(self) -> Relay:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self.open.set()
        self._server.close()
        self.cut()

    def cut(self) -> None:
        """End all connections, with the bytes that wait."""
        sockets, self._sockets = self._sockets, []
        for sock in sockets:
            with suppress(OSError):  # closed by the other side
                sock.shutdown(socket.SHUT_RDWR)
            sock.close()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                client, _ = self._server.accept()
                self.open.wait()
                try:
                    daemon = socket.create_connection(self._target)
                except OSError:  # the daemon does not run
                    client.close()
                    continue
                self._sockets += [client, daemon]
                for source, sink in ((client, daemon), (daemon, client)):
                    waiting = queue.SimpleQueue[tuple[float, bytes]]()
                    later = source is client
                    for work, words in (
                        (self._take, (source, waiting, later)),
                        (self._give, (waiting, sink)),
                    ):
                        threading.Thread(target=work, args=words, daemon=True).start()

    def _take(
        self,
        source: socket.socket,
        waiting: queue.SimpleQueue[tuple[float, bytes]],
        later: bool,
    ) -> None:
        data = b"-"
        while data:
            with suppress(OSError):
                data = b""
                data = source.recv(65536)
            waiting.put((time.monotonic() + self.seconds * later, data))

    def _give(self, waiting: queue.SimpleQueue[tuple[float, bytes]], sink: socket.socket) -> None:
        data = b"-"
        while data:
            due, data = waiting.get()
            time.sleep(max(0.0, due - time.monotonic()))
            self.open.wait()
            with suppress(OSError):
                if not data:
                    sink.shutdown(socket.SHUT_RDWR)
                sink.sendall(data)
