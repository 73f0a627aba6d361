"""Access control and message validation in front of viser.

viser accepts any websocket connection and trusts every message. It creates its server by
`websockets.asyncio.server.serve(handler, host, port, ...)`. During this call, that name is replaced by a function that
adds three documented parameters: `process_request` rejects unauthorised requests, `create_connection` checks messages
before viser receives them, and `max_size` is smaller. A viser that creates its server otherwise is stopped.
"""

from __future__ import annotations

import asyncio
import io
import logging
import re
import threading
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout, suppress
from http import HTTPStatus
from typing import Any

import msgspec
import viser
from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.protocol import State

from glassplat.access import Access, RefusedError
from glassplat.errors import InputError
from glassplat.files.records import COORDINATE, Choice, DictOf, Field, Integer, ListOf, Number, Optional, check_fields

LARGEST_MESSAGE = 64 * 1024
"""Bytes; a page sends cameras and values of controls."""
LONGEST_TEXT = 1000
LARGEST_WINDOW = 16_384
"""Maximum width and height of the browser's window, pixels."""
LEAST_LENGTH, MOST_LENGTH = 1e-3, 1e3
"""Bounds of the length of a quaternion."""
POSITION, QUATERNION = ListOf(COORDINATE, 3), ListOf(Number(-MOST_LENGTH, MOST_LENGTH), 4)
PAGE_PATH = re.compile(r"/|(/[\w@+-][\w@+.,-]{0,199}){1,8}", re.ASCII)
"""Path of a file of viser's page: no component starts with a dot, and no character is percent-encoded."""
HEADERS = {"X-Frame-Options": "DENY", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
HANDLER_DELAY_ITERATIONS = 4
"""Iterations of asyncio's loop from accepting a connection until its handler runs."""
_SERVE = threading.Lock()
log = logging.getLogger(__name__)


class ShortText(Field):
    """A name or a typed text; may be empty."""

    expected = f"a text of at most {LONGEST_TEXT} characters"

    def _is_valid(self, value: Any) -> bool:
        return isinstance(value, str) and len(value) <= LONGEST_TEXT


class ControlValue(Field):
    """Value of a control."""

    expected = "a number, true, false or a short text"

    def _convert(self, value: Any, where: str) -> Any:
        if isinstance(value, bool):
            return value
        return (ShortText() if isinstance(value, str) else COORDINATE).read(value, where)


GIZMO: dict[str, Field] = {"name": ShortText(), "owner": Optional(ShortText(), "")}
MESSAGES: dict[str, dict[str, Field]] = {
    "ViewerCameraMessage": {
        "wxyz": QUATERNION,
        "position": POSITION,
        "fov": Number(1e-3, 3.14),
        "near": COORDINATE,
        "far": COORDINATE,
        "image_height": Integer(1, LARGEST_WINDOW),
        "image_width": Integer(1, LARGEST_WINDOW),
        "look_at": POSITION,
        "up_direction": POSITION,
    },
    "GuiUpdateMessage": {"uuid": ShortText(), "updates": DictOf(ControlValue())},
    "TransformControlsUpdateMessage": {**GIZMO, "wxyz": QUATERNION, "position": POSITION},
    "TransformControlsDragStartMessage": GIZMO,
    "TransformControlsDragEndMessage": GIZMO,
    "ScenePointerMessage": {
        "event_type": Choice(("click",)),
        "ray_origin": POSITION,
        "ray_direction": ListOf(Number(-1.001, 1.001), 3),
        "screen_pos": ListOf(ListOf(Number(0, 1), 2), 1),
        "modifier": Choice((None,)),
    },
}
"""Accepted messages of browsers, by viser's names, with bounds of their fields; all others are ignored.

Ignored messages include requests to share the scene through a public server, uploads, and renderings sent by clients.
"""


def parse_message(data: str | bytes) -> bytes | None:
    """A message reduced to the fields listed in `MESSAGES`; None if it is to be ignored."""
    try:
        message = msgspec.msgpack.decode(data if isinstance(data, bytes) else b"")
        kind = message["type"]
        fields = check_fields(message, MESSAGES[kind], kind)
        quaternion = fields.get("wxyz", (1.0,))
        updates = fields.get("updates", {"value": 0})
        if sum(part * part for part in quaternion) < LEAST_LENGTH**2 or updates.keys() != {"value"}:
            return None
    except (ValueError, TypeError, KeyError, RecursionError):  # msgspec's errors are ValueErrors.
        return None
    return msgspec.msgpack.encode({"type": kind, **fields})


class GuardedConnection(ServerConnection):
    """A connection that drops messages other than those in `MESSAGES`."""

    async def recv(self, decode: bool | None = None) -> Any:
        """The next accepted message."""
        while (message := parse_message(await super().recv(decode))) is None:
            pass
        return message


class GuardedServe(serve):
    """A server whose shutdown closes every accepted connection."""

    async def __aexit__(self, *raised: Any) -> None:
        """Stops accepting connections, aborts those without a request, and closes the others.

        asyncio starts the handler of a connection some iterations of its loop after accepting it. If the server closes
        in between, the socket is left to the garbage collector, which prints a warning.
        """
        loop = asyncio.get_running_loop()
        with suppress(NotImplementedError):  # The event loop of Windows has no readers.
            for listening in self.server.sockets:
                loop.remove_reader(listening.fileno())
        for _ in range(HANDLER_DELAY_ITERATIONS):
            await asyncio.sleep(0)
        idle = {by: task for by, task in self.server.handlers.items() if by.protocol.state is State.CONNECTING}
        for connection, task in idle.items():
            connection.transport.abort()
            task.cancel()
        self.server.close()
        await self.server.wait_closed()


def request_filter(access: Access, page: Callable[..., Any] | None) -> Callable[[ServerConnection, Request], Any]:
    """A function for `process_request` that passes authorised requests to `page`, and rejects others."""

    def answer(connection: ServerConnection, request: Request) -> Any:
        try:
            login_headers = check_request(access, request)
        except RefusedError as refused:
            return make_response(refused.status, {"Content-Type": "text/plain; charset=utf-8"}, str(refused))
        if login_headers is not None:
            return make_response(HTTPStatus.OK, login_headers)
        if PAGE_PATH.fullmatch(request.path.partition("?")[0]) is None:  # viser may follow `..` out of its folder.
            return make_response(HTTPStatus.NOT_FOUND, {}, "there is no such page")
        response = None if page is None else page(connection, request)
        if isinstance(response, Response):
            for name, value in HEADERS.items():
                response.headers[name] = value
        return response

    return answer


def check_request(access: Access, request: Request) -> Mapping[str, str] | None:
    """None if a request is authorised; for a request with the key, the headers of the response.

    Raises:
        RefusedError: the request is not authorised.
    """
    hosts, origins, upgrades = (request.headers.get_all(name) for name in ("Host", "Origin", "Upgrade"))
    if len(hosts) != 1 or len(origins) > 1:
        raise RefusedError(HTTPStatus.BAD_REQUEST, "expected one host, and at most one origin")
    access.check_host(hosts[0])
    if upgrades or origins:
        access.check_origin(origins[0] if origins else None, hosts[0])
    login_headers = access.login_headers(request.path, hosts[0])
    if login_headers is None:
        access.check_cookie("; ".join(request.headers.get_all("Cookie")), hosts[0])
    return login_headers


def make_response(status: HTTPStatus, headers: Mapping[str, str], text: str = "") -> Response:
    """A response that viser does not handle."""
    body = text.encode()
    length = {"Content-Length": str(len(body)), "Cache-Control": "no-store", "Connection": "close"}
    return Response(status, status.phrase, Headers({**HEADERS, **length, **headers}), body)


def guarded_server(access: Access, *, host: str, port: int, title: str) -> viser.ViserServer:
    """A viser server that serves only requests authorised by `access`, and ignores unknown messages."""
    handler_modules: list[str] = []
    with _SERVE, redirect_stdout(io.StringIO()):  # Commands print the address themselves, not viser's table.
        original_serve: Any = websockets_server.serve

        def guarded(handler: Callable[..., Any], *where: Any, **options: Any) -> Any:
            if not (getattr(handler, "__module__", None) or "").startswith("viser."):
                return original_serve(handler, *where, **options)
            handler_modules.append(handler.__module__)
            page = request_filter(access, options.get("process_request"))
            more = {"create_connection": GuardedConnection, "process_request": page, "max_size": LARGEST_MESSAGE}
            return GuardedServe(handler, *where, **options | more)

        websockets_server.serve = guarded  # type: ignore[assignment, misc]
        try:
            found = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        finally:
            websockets_server.serve = original_serve  # type: ignore[misc]
        if not handler_modules:
            found.stop()
            raise InputError(
                f"viser {viser.__version__} starts its server in a way that glassplat cannot protect: anybody "
                "could connect; pip install viser==1.1.1"
            )
    found.get_event_loop().set_exception_handler(_log_error)
    return found


def _log_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Logs the error of a message instead of printing its traceback."""
    log.debug("a message of a browser was rejected: %s", context.get("exception") or context.get("message"))
