"""Server of the page for marking panes, for browsers on this computer only.

The page sends only indices of views, outlines and one document, never a path. Other users of the computer and pages of
other sites are rejected, because they do not know the key, which is part of the address that the command prints.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from glassplat.access import LOCALHOST, Access, RefusedError
from glassplat.annotate.session import PHOTOGRAPH_SIDE, THUMBNAIL_SIDE, ChangedElsewhereError, Session
from glassplat.errors import InputError
from glassplat.files.records import parse_json

LARGEST_BODY = 8_000_000
PAGE_FILES = {
    "/page.js": "text/javascript",
    "/drawing.js": "text/javascript",
    "/marking.js": "text/javascript",
    "/style.css": "text/css",
}
POLICY = "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"


class AnnotationServer(ThreadingHTTPServer):
    """Serves one session until it is stopped.

    Attributes:
        session: the capture that is marked.
        access: access control of requests.
        is_finished: the page has requested to stop the server.
    """

    daemon_threads = True

    def __init__(self, session: Session, port: int) -> None:
        """Starts to listen; `port` 0 picks a free one."""
        self.session = session
        self.access = Access()
        self.is_finished = False
        try:
            super().__init__((LOCALHOST, port), PageHandler)
        except OSError as error:
            reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise InputError(f"port {port} {reason}; choose another with --port, or 0 for any that is free") from error

    @property
    def address(self) -> str:
        """Address to open in the browser."""
        return f"http://{LOCALHOST}:{self.server_address[1]}/?key={self.access.key}"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignores errors of connections that browsers close during a response."""


class PageHandler(BaseHTTPRequestHandler):
    """Handler of one connection."""

    server: AnnotationServer
    server_version = "glassplat"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        """Sends the page, its files, photographs, and the description of the capture."""
        self._respond(self._get)

    def do_POST(self) -> None:
        """Handles a changed document, a rough outline, and the requests to write results and to stop."""
        self._respond(self._post)

    def log_message(self, format: str, *values: Any) -> None:
        """Suppresses request logs."""

    def _respond(self, work: Callable[[], None]) -> None:
        try:
            self.server.access.check_host(self._host)
            work()
        except RefusedError as refused:
            self.close_connection = True
            self._send_json({"error": str(refused)}, refused.status)
        except ChangedElsewhereError as error:
            self._send_json({"error": str(error), **error.response}, HTTPStatus.CONFLICT)
        except (ValueError, OSError) as error:
            self._send_json({"error": str(error)}, HTTPStatus.BAD_REQUEST)

    def _get(self) -> None:
        path = urlsplit(self.path).path
        if path == "/favicon.ico":  # Browsers ask for it with every answer, even one with an error or without a page.
            self._send(b"", "image/x-icon")
            return
        if path == "/":
            self._send_page()
            return
        self._check_key()
        if path in PAGE_FILES:
            self._send_file(path.removeprefix("/"), PAGE_FILES[path])
        elif path == "/capture":
            self._send_json(self.server.session.describe())
        elif path.startswith("/photo/"):
            self._send_photograph(path.removeprefix("/photo/"), PHOTOGRAPH_SIDE)
        elif path.startswith("/thumbnail/"):
            self._send_photograph(path.removeprefix("/thumbnail/"), THUMBNAIL_SIDE)
        else:
            raise RefusedError(HTTPStatus.NOT_FOUND, "there is no such page")

    def _post(self) -> None:
        self.server.access.check_origin(self.headers.get("Origin"), self._host)
        self._check_key()
        path, session = urlsplit(self.path).path, self.server.session
        body = self._body()
        if path == "/document":
            self._send_json(session.save(parse_json(body, "the document of the page")))
        elif path == "/grab":
            self._send_json(session.grab(parse_json(body, "the outline of the page")))
        elif path == "/results":
            self._send_json(session.finish())
        elif path == "/close":
            self.server.is_finished = True
            # Sent before the shutdown, which waits for the loop of the server.
            self._send_json({"warning": session.unwritten_warning})
            Thread(target=self.server.shutdown, daemon=True).start()
        else:
            raise RefusedError(HTTPStatus.NOT_FOUND, "there is no such page")

    @property
    def _host(self) -> str:
        return self.headers.get("Host") or ""

    def _check_key(self) -> None:
        self.server.access.check_cookie(self.headers.get("Cookie") or "", self._host)

    def _body(self) -> str:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > LARGEST_BODY:
            raise RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {LARGEST_BODY} bytes")
        return self.rfile.read(int(length)).decode("utf-8")

    def _send_page(self) -> None:
        login_headers = self.server.access.login_headers(self.path, self._host)
        if login_headers is not None:
            self._send(b"", "text/plain", HTTPStatus.OK, login_headers)
            return
        self._check_key()
        self._send_file("index.html", "text/html")

    def _send_file(self, name: str, kind: str) -> None:
        self._send((resources.files("glassplat.annotate") / "page" / name).read_bytes(), kind)

    def _send_photograph(self, number: str, longest: int) -> None:
        if not number.isdecimal() or len(number) > 9 or int(number) >= len(self.server.session.views):
            raise RefusedError(HTTPStatus.NOT_FOUND, "there is no such view")
        jpeg = self.server.session.photograph_jpeg(int(number), longest)
        self._send(jpeg, "image/jpeg")

    def _send_json(self, value: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(value).encode(), "application/json", status)

    def _send(
        self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK, headers: dict[str, str] | None = None
    ) -> None:
        self.send_response(status)
        standard = {
            "Content-Type": f"{kind}; charset=utf-8" if kind.startswith("text") else kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }
        for name, value in (standard | (headers or {})).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
