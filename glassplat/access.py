"""Access control of the servers: only users with the link, and only from the server's own page.

A browser sends requests on behalf of any page that it shows. Three checks reject foreign ones:

- The *key* is part of the link that a command prints. The first request with it gets a cookie, and the key is removed
from the address bar. Requests without the cookie are rejected.
- The *host* that the browser requests must be a name of this computer, if the server only serves this computer. This
prevents DNS rebinding.
- The *origin* of requests that change something must be the server's own page.
"""

from __future__ import annotations

import ipaddress
import secrets
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

LOCALHOST = "127.0.0.1"
LOCAL_NAMES = (LOCALHOST, "localhost", "[::1]")
"""Accepted names of the host, with any port, since SSH forwarding may use another port."""
OPEN_LINK_HINT = "open the address that the command printed, including its key"


class RefusedError(Exception):
    """A rejected request, with its HTTP `status`."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class Access:
    """The key of a server, and the checks of its requests.

    Attributes:
        key: secret part of the link.
    """

    def __init__(self, host: str = LOCALHOST) -> None:
        """Makes a key; `host` is the address of the server."""
        self.key = secrets.token_urlsafe(16)
        self._is_local = is_local(host)

    def check_host(self, host: str) -> None:
        """Refuse host names that a foreign name server may point to this computer.

        Raises:
            RefusedError: the header `Host` is not in `LOCAL_NAMES`, and only this computer is served.
        """
        if not host or (self._is_local and _split_host(host)[0] not in LOCAL_NAMES):
            raise RefusedError(HTTPStatus.FORBIDDEN, "this page is served only to this computer")

    def check_origin(self, origin: str | None, host: str) -> None:
        """Refuse requests sent by pages of other sites.

        Raises:
            RefusedError: the header `Origin` is missing, or not that of a page from `host`.
        """
        if origin is None or _netloc(origin) != host.lower():
            raise RefusedError(HTTPStatus.FORBIDDEN, "a request from another site")

    def check_cookie(self, cookies: str, host: str) -> None:
        """Refuse requests without the key.

        Raises:
            RefusedError: the header `Cookie` does not hold the key.
        """
        # Parsed by hand, because `http.cookies` rejects all cookies if another program set an invalid one.
        pairs = [cookie.partition("=") for cookie in cookies.split(";")]
        if not any(self._is_key(value.strip()) for name, _, value in pairs if name.strip() == cookie_name(host)):
            raise RefusedError(HTTPStatus.FORBIDDEN, OPEN_LINK_HINT)

    def login_headers(self, path: str, host: str) -> dict[str, str] | None:
        """Headers of the answer to a first request, with the key in its path; None for any other path.

        Raises:
            RefusedError: the key is wrong.
        """
        try:
            address = urlsplit(path)
            given = parse_qs(address.query, max_num_fields=16).get("key", [""])[0]
        except ValueError:
            return None
        if address.path != "/" or not given:
            return None
        if not self._is_key(given):
            raise RefusedError(HTTPStatus.FORBIDDEN, "the key is from another session; use the printed address")
        cookie = f"{cookie_name(host)}={self.key}; HttpOnly; SameSite=Strict; Path=/"
        # Not a redirection: after a link on another page, a browser would follow it without the cookie.
        return {"Set-Cookie": cookie, "Refresh": "0; url=/"}

    def _is_key(self, given: str) -> bool:
        return secrets.compare_digest(given.encode("utf-8", "surrogateescape"), self.key.encode())


def is_local(host: str) -> bool:
    """Return whether an address can be reached only from this computer."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def cookie_name(host: str) -> str:
    """Name of the cookie, with the port, because browsers send the cookies of a host to all its ports."""
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
