"""Limits on what a peer costs: connections without an accepted request are few, and unread bytes are bounded.

Anybody who reaches the port can open connections. Each of them takes a descriptor and memory until its request has come
and was accepted, so the oldest is closed where there are too many. A browser sends its request with the connection and
is not the oldest.

A browser gets a frame when it asks for one, and the server waits until it is sent. The library answers pings at once,
whether the peer reads or not, hence the limit on bytes that wait.
"""

from __future__ import annotations

import asyncio
import logging
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

MOST_UNAUTHENTICATED = 128
"""connections at the same time; a browser opens up to six for one page"""
REQUEST_S = 10.0
"""time in which a request must have come and been answered"""
LONGEST_LINE = 8192
"""bytes of a request line that websockets takes"""
MOST_UNREAD = 4 * 2**20
"""bytes that may wait for a peer: a frame of the largest array, and more; one that reads none of them is hung up on"""

_log = logging.getLogger("ohmskin")


class Unauthenticated:
    """The connections whose requests have not been accepted, the oldest first."""

    def __init__(self) -> None:
        self._waiting: dict[ServerConnection, None] = {}

    def accept(self, connection: ServerConnection) -> None:
        """The connection has become a browser's, or is closed."""
        self._waiting.pop(connection, None)

    def connections(self) -> type[ServerConnection]:
        """For ``create_connection`` of the server: the class of its connections."""
        from websockets.asyncio.server import ServerConnection

        unauthenticated = self

        class Connection(ServerConnection):
            """Waits to be accepted, and answers a request line that is not ASCII, which websockets hangs up on."""

            def __init__(self, *args: Any, **options: Any) -> None:
                super().__init__(*args, **options)
                self._line: bytes | None = b""
                """beginning of the request line; None: it has come"""

            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                super().connection_made(transport)
                unauthenticated._add(self)

            def connection_lost(self, exc: Exception | None) -> None:
                unauthenticated.accept(self)
                super().connection_lost(exc)

            def data_received(self, data: bytes) -> None:
                if self._line is not None:
                    data = self._line + data
                    line, end, _ = data.partition(b"\n")
                    if not end and len(data) <= LONGEST_LINE:
                        self._line = data
                        return
                    self._line = None
                    if end and not line.isascii():
                        self.transport.write(_NOT_ASCII)
                        self.transport.close()
                        return
                super().data_received(data)
                if self.transport.get_write_buffer_size() > MOST_UNREAD:
                    _log.warning(
                        "hung up on the browser at %s: it sends pings and reads no answers", self.remote_address
                    )
                    self.transport.abort()

        return Connection

    def hang_up(self) -> None:
        """Close all of them."""
        for connection in list(self._waiting):
            connection.transport.abort()

    def _add(self, connection: ServerConnection) -> None:
        self._waiting[connection] = None
        if len(self._waiting) > MOST_UNAUTHENTICATED:
            oldest = next(iter(self._waiting))
            self.accept(oldest)
            oldest.transport.abort()


_BAD = HTTPStatus.BAD_REQUEST
_NOT_ASCII = f"HTTP/1.1 {_BAD.value} {_BAD.phrase}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode()
