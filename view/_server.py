"""The web server: static files over HTTP and frames over WebSockets, both by the library `websockets`."""

from __future__ import annotations

import asyncio
import errno
import importlib.resources
import logging
import socket
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING

from ..common.extras import install_command
from ..errors import InputError, MissingExtra
from ._access import Access, Refused
from ._orders import LARGEST_BYTES
from ._session import Session
from ._source import Source
from ._unauthenticated import REQUEST_S, Unauthenticated

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

SOCKET_PATH = "frames"
MOST_BROWSERS = 32
"""that are served at the same time"""
SECURITY = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class Page:
    """A page that is being served."""

    url: str
    """to open in a browser, with the token where one is needed"""
    port: int


@asynccontextmanager
async def serve(source: Source, *, host: str = "127.0.0.1", ports: Sequence[int] = (0,)) -> AsyncIterator[Page]:
    """Serve the page of a source while the block lasts.

    Args:
        source: what to show; it must have begun.
        host: name or address to listen on. All but the loopback need the token that is part of the page's address.
        ports: TCP ports, of which the first free one is taken; 0: any that is free.

    Raises:
        InputError: the address is not this machine's, or is in use.
        MissingExtra: `websockets` is not installed.

    """
    try:
        from websockets.asyncio.server import serve as listen
    except ImportError as error:
        raise MissingExtra(f"the page needs websockets: {install_command('view')}") from error
    # Unauthenticated peers must not fill the terminal: what they send wrong is answered, and not logged.
    quiet = logging.getLogger("ohmskin.view")
    quiet.setLevel(logging.CRITICAL + 1)
    unauthenticated = Unauthenticated()
    desk = _FrontDesk(source, Access.for_host(host), _files(), unauthenticated)
    server = None
    with _asyncio_tells(quiet):
        for port in ports:
            try:
                server = await listen(
                    desk.follow,
                    host,
                    port,
                    process_request=desk.answer,
                    compression=None,  # frames of float32 hardly shrink, at a cost per frame
                    max_size=LARGEST_BYTES,
                    max_queue=4,
                    open_timeout=REQUEST_S,
                    create_connection=unauthenticated.connections(),
                    logger=quiet,
                    server_header=None,
                )
                break
            except OSError as error:
                if port == ports[-1]:
                    raise InputError(_why_not(error, host, port)) from error
        assert server is not None
        try:
            found = next(iter(server.sockets)).getsockname()[1]
            yield Page(f"http://{_shown_host(host)}:{found}{desk.access.prefix}", found)
        finally:
            unauthenticated.hang_up()
            await _shut(server)


@contextmanager
def _asyncio_tells(logger: logging.Logger) -> Iterator[None]:
    """Let asyncio tell ``logger`` what goes wrong, such as too many open files, and not the terminal."""
    loop = asyncio.get_running_loop()
    before = loop.get_exception_handler()
    loop.set_exception_handler(
        lambda _, context: logger.error("%s", context["message"], exc_info=context.get("exception"))
    )
    try:
        yield
    finally:
        loop.set_exception_handler(before)


async def _shut(server: Server) -> None:
    for connection in server.connections:
        connection.transport.abort()  # a browser that does not read would hold up the end
    server.close()
    await server.wait_closed()


class _FrontDesk:
    """Answers requests: a file, a WebSocket, or a refusal."""

    def __init__(
        self, source: Source, access: Access, files: Mapping[str, tuple[str, bytes]], unauthenticated: Unauthenticated
    ) -> None:
        self.access = access
        self._unauthenticated = unauthenticated
        self._source = source
        self._files = files
        self._browsers = 0

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The response to a request; None: a WebSocket is opened."""
        try:
            if getattr(request, "method", "GET") != "GET":
                raise Refused(HTTPStatus.METHOD_NOT_ALLOWED, "only GET is answered")
            path = self.access.local_path(request.path, request.headers)
            if path == SOCKET_PATH:
                self.access.check_origin(request.headers)
                if self._browsers >= MOST_BROWSERS:
                    raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_BROWSERS} browsers are served already")
                return None
            if path == "/":
                return _response(HTTPStatus.MOVED_PERMANENTLY, "text/plain", b"", Location=self.access.prefix)
            kind, content = self._files[path or "index.html"]
        except KeyError:
            return _response(HTTPStatus.NOT_FOUND, "text/plain", b"there is no such page\n")
        except Refused as error:
            return _response(error.status, "text/plain", f"{error}\n".encode())
        except (LookupError, ValueError):  # two Host headers; an address with half a bracket
            return _response(HTTPStatus.BAD_REQUEST, "text/plain", b"a request that contradicts itself\n")
        return _response(HTTPStatus.OK, kind, content)

    async def follow(self, connection: ServerConnection) -> None:
        """Serve one browser until it leaves."""
        self._unauthenticated.accept(connection)
        self._browsers += 1
        try:
            await Session(connection, self._source).run()
        finally:
            self._browsers -= 1


def _response(status: HTTPStatus, kind: str, content: bytes, **more: str) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(content)), "Connection": "close"}
    return Response(status.value, status.phrase, Headers(headers | SECURITY | more), content)


def _files() -> dict[str, tuple[str, bytes]]:
    """The page's files: name -> media type and content."""
    types = {"js": "text/javascript", "css": "text/css", "html": "text/html", "svg": "image/svg+xml"}
    folder = importlib.resources.files(__package__) / "page"
    return {
        file.name: (types[kind], file.read_bytes())
        for file in folder.iterdir()
        if (kind := file.name.rpartition(".")[2]) in types
    }


def _why_not(error: OSError, host: str, port: int) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"{host}: port {port} is in use by another program; expected a free one, or 0 for any"
    if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
        return f"{host}: is no address of this machine"
    return f"{host}: port {port} cannot be listened on: {error.strerror or error}"


def _shown_host(host: str) -> str:
    """A name for the address of the page; for "all addresses" the one that other machines reach this one by."""
    if host in ("", "0.0.0.0", "::"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                # Sends nothing: it only asks the routing table. The address is reserved for documentation.
                probe.connect(("192.0.2.1", 9))
                host = probe.getsockname()[0]
            except OSError:
                host = socket.gethostname()
    return f"[{host}]" if ":" in host else host
