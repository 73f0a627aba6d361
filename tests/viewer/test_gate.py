"""Access to a viewer: clients that are admitted, messages that are accepted, and limits that keep these harmless."""

from __future__ import annotations

import asyncio
import gc
import math
import socket
import warnings
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest
import torch
import viser
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request

from glassplat.access import cookie_name
from glassplat.errors import InputError
from glassplat.viewer import gate
from glassplat.viewer.gate import LARGEST_MESSAGE, MESSAGES, parse_message
from glassplat.viewer.server import MOST_PIXELS, Viewer
from tests.viewer.free_port import free_port
from tests.viewer.test_server import STATE
from tools.viewer_client import ViewerClient, page


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    made = Viewer(STATE, "127.0.0.1", free_port())
    made.start()
    yield made
    made.stop()


def with_client(viewer: Viewer, work: Callable[[ViewerClient], Awaitable[None]]) -> None:
    async def connected() -> None:
        async with ViewerClient(viewer.address) as client:
            await client.picture()
            await work(client)

    asyncio.run(connected())


@pytest.mark.parametrize(
    "stranger",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": None},
        {"origin": "http://localhost:1"},
        {"host": "evil.example:80", "origin": "http://evil.example:80"},
        {"key": ""},
        {"key": "guessed"},
        {"origin": "http://[localhost"},
    ],
    ids=str,
)
def test_a_request_without_the_key_is_refused(stranger: dict[str, Any], viewer: Viewer) -> None:
    async def tried() -> int:
        try:
            async with ViewerClient(viewer.address, **stranger):
                return 101
        except InvalidStatus as refused:
            return refused.response.status_code

    assert asyncio.run(tried()) == 403


def test_through_ssh_the_port_is_another_one(viewer: Viewer) -> None:
    async def looked(host: str) -> None:
        async with ViewerClient(viewer.address, host=host, origin=f"http://{host}") as client:
            await client.picture()

    for host in ("localhost:9999", "127.0.0.1:9999", "[::1]:9999", "localhost"):
        asyncio.run(looked(host))


def test_the_page_needs_the_key_which_leaves_the_address(viewer: Viewer) -> None:
    assert page(viewer.address)[0] == 403
    assert page(viewer.address, "/?key=guessed")[0] == 403
    status, headers, _ = page(viewer.address, f"/?key={viewer.access.key}")
    assert status == 200 and headers["Refresh"] == "0; url=/"
    assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
    cookie = headers["Set-Cookie"].split(";")[0]
    status, headers, body = page(viewer.address, Cookie=cookie)
    assert status == 200 and b"<html" in body and headers["X-Frame-Options"] == "DENY"
    assert page(viewer.address, Cookie=cookie, Host="evil.example")[0] == 403
    assert page(viewer.address, Cookie=cookie, Origin="http://evil.example")[0] == 403


PATHS_OUT = (
    "/../x", "/a/../../etc/passwd", "/%2e%2e/x", "/..%2fx", "/a\\..\\x", "//etc/passwd", "/.ssh", "etc", "",
    "/" + 999 * "a",
)  # fmt: skip


@pytest.mark.parametrize("path", PATHS_OUT)
def test_no_path_leads_out_of_the_page_s_folder(path: str, viewer: Viewer) -> None:
    """viser 1.0 follows every requested path."""
    asked: list[Request] = []
    answer = gate.request_filter(viewer.access, lambda connection, request: asked.append(request))
    cookie = f"{cookie_name('localhost:80')}={viewer.access.key}"
    refused = answer(None, Request(path, Headers({"Host": "localhost:80", "Cookie": cookie})))
    assert not asked and refused.status_code == 404


def test_every_file_of_the_page_is_served(viewer: Viewer) -> None:
    root = Path(viser.__file__).parent / "client" / "build"
    cookie = f"{cookie_name(urlsplit(viewer.address).netloc)}={viewer.access.key}"
    for file in root.rglob("*.*"):
        path = f"/{file.relative_to(root).as_posix()}?v=1"
        assert not file.is_file() or page(viewer.address, path, Cookie=cookie)[0] == 200, path


def test_any_host_name_is_accepted_if_the_server_is_public() -> None:
    viewer = Viewer(STATE, "0.0.0.0", free_port())
    viewer.start()
    try:
        address = f"http://localhost:{viewer.port}/?key={viewer.access.key}"
        assert page(address, Host="gpu.lan:80")[0] == 403
        assert page(address, Host="gpu.lan:80", Cookie=f"glassplat_80={viewer.access.key}")[0] == 200
        assert "0.0.0.0" not in viewer.address
    finally:
        viewer.stop()


CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0, 0, 0], "position": [0.0, 0, 0], "fov": 1.0, "near": 0.1, "far": 9.0,
    "image_height": 10, "image_width": 10, "look_at": [0.0, 0, 1], "up_direction": [0.0, 1, 0],
}  # fmt: skip
POISON = (0, -1.0, math.nan, math.inf, -math.inf, 1e300, "1", None, [], {}, True)
BAD_CAMERAS = [
    *({"fov": value} for value in (*POISON, 3.2)),
    *({name: value} for name in ("image_height", "image_width") for value in (*POISON[:-1], 1.5, 2**40)),
    *({"wxyz": [value, 0.0, 0.0, 0.0]} for value in POISON if value != -1.0 and value is not True),
    *({"position": [0.0, value, 0.0]} for value in POISON[2:]),
    {"wxyz": [1.0, 0, 0]},
    {"type": "ShareUrlRequest"},
    {"type": 5},
    {"type": ["ViewerCameraMessage"]},
]


def test_a_camera_out_of_bounds_is_ignored() -> None:
    assert parse_message(msgspec.msgpack.encode(CAMERA)) is not None
    accepted = [change for change in BAD_CAMERAS if parse_message(msgspec.msgpack.encode(CAMERA | change)) is not None]
    assert not accepted


@pytest.mark.parametrize(
    "message",
    [
        "text", b"", b"\xff", b"\x91" * 60_000, msgspec.msgpack.encode([1]), msgspec.msgpack.encode({}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": [1]}}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"update_cb": 1}}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": "x" * 1001}}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": math.nan}}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a", "updates": {}}),
    ],
)  # fmt: skip
def test_unknown_messages_are_ignored(message: str | bytes) -> None:
    assert parse_message(message) is None


def test_every_accepted_message_exists_in_viser_with_these_fields() -> None:
    kinds = viser._messages.Message._subclass_from_type_string()
    for name, fields in MESSAGES.items():
        assert set(fields) <= set(kinds[name].__dataclass_fields__), name


def test_invalid_messages_of_a_client_do_not_affect_others(
    viewer: Viewer, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    async def work(client: ViewerClient) -> None:
        for change in BAD_CAMERAS:
            await client.connection.send(msgspec.msgpack.encode(CAMERA | change))
        for fov in (1e-3, 3.14):
            await client.look(fov=fov)
        await client.look(image_width=16_384, image_height=1)
        await client.look(image_width=1, image_height=16_384)
        await client.look(position=(1e12, -1e12, 1e12))
        await client.set("Layer", "rgb")
        for label in client.labels():
            for value in ("", "nan", "inf", "no such", -1e9, 1e9, True, "\x1b[31m<script>"):
                await client.set(label, value)
        for name in client.gizmos:
            await client.send("TransformControlsUpdateMessage", name=name, wxyz=[1e-3, 0, 0, 0], position=[1e12, 0, 0])
        await asyncio.sleep(0.5)

    with_client(viewer, work)
    with_client(viewer, lambda client: client.picture())
    output = "".join(capfd.readouterr())
    assert "Traceback" not in output and "Task failed" not in output
    assert not [record for record in caplog.records if record.exc_info]


def test_a_message_that_is_too_long_ends_its_connection_only(viewer: Viewer) -> None:
    async def work(client: ViewerClient) -> None:
        await client.connection.send(b"\x00" * (LARGEST_MESSAGE + 1))
        await client.connection.wait_closed()
        assert client.connection.close_code == 1009

    with_client(viewer, work)
    with_client(viewer, lambda client: client.picture())


def test_a_window_of_any_shape_gets_a_picture_of_bounded_size(viewer: Viewer) -> None:
    drawn: list[tuple[int, ...]] = []
    show = viewer.loop._show
    viewer.loop._show = lambda client, picture, is_sharp: (drawn.append(picture.shape), show(client, picture, is_sharp))

    async def work(client: ViewerClient) -> None:
        for size in ((16_384, 1080), (100, 16_384)):
            drawn.clear()
            await client.look(image_width=size[0], image_height=size[1])
            async with asyncio.timeout(60):
                while not drawn:
                    await asyncio.sleep(0.02)
            assert all(shape[0] * shape[1] <= 1.01 * MOST_PIXELS for shape in drawn)

    try:
        with_client(viewer, work)
    finally:
        viewer.loop._show = show


def test_a_missing_photograph_does_not_stop_the_viewer(capfd: pytest.CaptureFixture[str]) -> None:
    """It is renamed, or its disk unplugged, while a client is connected."""
    gone = False

    def photograph() -> torch.Tensor:
        if gone:
            raise FileNotFoundError("no such photograph")
        return torch.zeros(28, 28, 3, dtype=torch.uint8)

    photographs = dict.fromkeys(STATE.photographs, photograph)
    state = replace(STATE, photographs=photographs)
    viewer = Viewer(state, "127.0.0.1", free_port())
    viewer.start()

    async def work(client: ViewerClient) -> None:
        nonlocal gone
        gone = True
        await client.set("Go to", state.cameras[2][0])
        await client.picture()
        await client.set("Layer", "error")
        async with asyncio.timeout(60):
            while not any("no such photograph" in note for note in client.notes):
                await asyncio.sleep(0.02)
        await client.set("Layer", "rgb")
        await client.picture()

    try:
        with_client(viewer, work)
        with_client(viewer, lambda client: client.picture())
    finally:
        viewer.stop()
    assert "Traceback" not in "".join(capfd.readouterr())


def test_an_unsupported_version_of_viser_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A later version might create its server with another function."""
    stopped: list[bool] = []

    class Elsewhere:
        def __init__(self, **options: Any) -> None:
            pass

        def stop(self) -> None:
            stopped.append(True)

    serve = gate.websockets_server.serve
    monkeypatch.setattr(gate.viser, "ViserServer", Elsewhere)
    with pytest.raises(InputError, match="cannot protect"):
        Viewer(STATE, "127.0.0.1", free_port())
    assert stopped and gate.websockets_server.serve is serve


def test_a_server_that_ends_leaves_no_connection_open() -> None:
    """Not even one that was just accepted, or that makes no request."""

    async def knocked(turns: int) -> socket.socket:
        async with gate.GuardedServe(lambda connection: asyncio.sleep(0), "127.0.0.1", 0) as server:
            knocking = socket.create_connection(server.sockets[0].getsockname(), timeout=10)
            for _ in range(turns):
                await asyncio.sleep(0)
        return knocking

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        for turns in range(8):
            with asyncio.run(knocked(turns)) as left, suppress(ConnectionResetError):
                assert left.recv(1) == b""
        gc.collect()
    assert not [str(one.message) for one in caught if issubclass(one.category, ResourceWarning)]
