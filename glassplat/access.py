"""Access to our servers: for whoever was given the link, from its own page.

A browser sends requests for any page that it shows, those of strangers included. Three checks tell them apart:

- The *key* is part of the link that a command prints. The first request with it gets a cookie, and the key leaves the
  address bar. Without the cookie there is no answer.
- The *host* that a browser believes it talks to is a name of this computer, where the server is there for this computer
  only. Somebody else's name that was made to lead here (DNS rebinding) is refused.
- The *origin* of what changes something is the server's own page, not another one that knows the address.
"""

from __future__ import annotations

import ipaddress
import secrets
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

LOCAL = "127.0.0.1"
LOCAL_NAMES = (LOCAL, "localhost", "[::1]")
"""Of the host that a browser may say that it talks to, with any port: over SSH it is another one than ours."""
OPEN_THE_LINK = "open the address that the command printed, with its key"


class RefusedError(Exception):
    """A request that is not answered; `status` says why."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class Access:
    """The key of one server, and the checks of what comes to it.

    Attributes:
        key: what a browser has to know.
    """

    def __init__(self, host: str = LOCAL) -> None:
        """Makes a key; `host` is the address that is listened on."""
        self.key = secrets.token_urlsafe(16)
        self._is_local = is_local(host)

    def check_host(self, host: str) -> None:
        """Refuse names that somebody else's name server may let point to this computer.

        Raises:
            RefusedError: the header `Host` is none of `LOCAL_NAMES`, and only this computer is served.
        """
        if not host or (self._is_local and _split_host(host)[0] not in LOCAL_NAMES):
            raise RefusedError(HTTPStatus.FORBIDDEN, "this page is served to this computer only")

    def check_origin(self, origin: str | None, host: str) -> None:
        """Refuse what pages of other sites have a browser send.

        Raises:
            RefusedError: the header `Origin` is missing, or not that of a page from `host`.
        """
        if origin is None or _netloc(origin) != host.lower():
            raise RefusedError(HTTPStatus.FORBIDDEN, "a request of another site")

    def check_cookie(self, cookies: str, host: str) -> None:
        """Refuse who was not given the link.

        Raises:
            RefusedError: the header `Cookie` does not hold the key.
        """
        # By hand, as `http.cookies` gives up on all of them where another program of this computer set an odd one.
        pairs = [cookie.partition("=") for cookie in cookies.split(";")]
        if not any(self._is_key(value.strip()) for name, _, value in pairs if name.strip() == cookie_name(host)):
            raise RefusedError(HTTPStatus.FORBIDDEN, OPEN_THE_LINK)

    def entry(self, path: str, host: str) -> dict[str, str] | None:
        """Headers that answer a first request, which carries the key in its path; None for any other path.

        Raises:
            RefusedError: the key is another one.
        """
        try:
            address = urlsplit(path)
            given = parse_qs(address.query, max_num_fields=16).get("key", [""])[0]
        except ValueError:
            return None
        if address.path != "/" or not given:
            return None
        if not self._is_key(given):
            raise RefusedError(
                HTTPStatus.FORBIDDEN, "the key is that of another session; take the address that was printed"
            )
        cookie = f"{cookie_name(host)}={self.key}; HttpOnly; SameSite=Strict; Path=/"
        # No redirection: where the link stood on another page, a browser would follow that without the cookie.
        return {"Set-Cookie": cookie, "Refresh": "0; url=/"}

    def _is_key(self, given: str) -> bool:
        return secrets.compare_digest(given.encode("utf-8", "surrogateescape"), self.key.encode())


def is_local(host: str) -> bool:
    """Return whether an address to listen on can be reached from this computer only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def cookie_name(host: str) -> str:
    """The cookie's name, by the port that the browser sees: it sends the cookies of a host to all its ports."""
    return f"glassplat_{_split_host(host)[1] or 80}"


def _split_host(host: str) -> tuple[str, str]:
    """Name and port of a header `Host`."""
    name, colon, port = host.lower().rpartition(":")
    return (name, port) if colon and port.isdecimal() and port.isascii() else (host.lower(), "")


def _netloc(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None
