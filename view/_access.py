"""Who may see the page: checks of token, Host and Origin, against other machines and other pages in the browser.

On the loopback the page has no token. Two attacks come from web pages that the user has open elsewhere: such a page can
open a WebSocket to the loopback (cross-site WebSocket hijacking; the browser then sends that page's Origin), and it can
have its own host name resolve to the loopback (DNS rebinding; the browser then sends that name as Host). Both headers
are checked. Any other address needs a token, the first part of the path, so that everything the page loads carries it.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from urllib.parse import urlsplit

from ..common.checks import is_loopback
from ..errors import OhmskinError

TOKEN_BYTES = 32


class Refused(OhmskinError):
    """A request that gets no answer but an HTTP status."""

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class Access:
    """The rule for one server."""

    token: str
    """empty: none is needed, and only names of the loopback are answered"""

    @classmethod
    def for_host(cls, host: str) -> Access:
        """A new token, unless ``host`` is the loopback."""
        return cls("" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES))

    @property
    def prefix(self) -> str:
        """First part of every path."""
        return f"/{self.token}/" if self.token else "/"

    def local_path(self, target: str, headers: Mapping[str, str]) -> str:
        """The path of a request below the prefix, if it may be answered.

        Raises:
            Refused: it may not.

        """
        host = headers.get("Host", "")
        if not self.token and not is_loopback(_name(host)):
            raise Refused(HTTPStatus.FORBIDDEN, "this name is not the loopback's")
        path = urlsplit(target).path
        given, slash, rest = path.removeprefix("/").partition("/")
        if self.token and not hmac.compare_digest(given.encode(), self.token.encode()):
            raise Refused(HTTPStatus.FORBIDDEN, "the address needs the token that ohmskin printed")
        if self.token:
            return rest if slash else "/"
        return path.removeprefix("/")

    def check_origin(self, headers: Mapping[str, str]) -> None:
        """Refuse a WebSocket that another page than ours asks for."""
        origin = urlsplit(headers.get("Origin", ""))
        if origin.scheme not in ("http", "https") or origin.netloc != headers.get("Host", ""):
            raise Refused(HTTPStatus.FORBIDDEN, "only the page itself may open the connection")


def _name(host: str) -> str:
    """The name or address in a Host header; empty where there is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
