"""Attacks on `view` and `annotate`: none gets access or changes files, and the next client is served.

The servers run in this process. After every case a client with the link has to be served, no traceback may have been
printed, and the marks of the capture must be unchanged. The first case passes photographs and captures with HTML in
their names through `prepare`, training, `eval` and `export`.
"""

from __future__ import annotations

import asyncio
import io
import json
import random
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, redirect_stderr, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import torch
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from glassplat.access import cookie_name
from glassplat.annotate.server import AnnotationServer
from glassplat.files.images import write_image
from glassplat.prepare.preparation import PAGE
from glassplat.render.planar import Planar
from glassplat.viewer.drawing import ViewerState
from glassplat.viewer.gate import LARGEST_MESSAGE, MESSAGES
from glassplat.viewer.server import Viewer
from tests.annotate.conftest import serving, write_room
from tests.prepare.conftest import copy_photographs
from tests.training.tiny_capture import tiny_capture, true_scene, write_tiny_capture
from tests.viewer.free_port import free_port
from tools.trial import Case
from tools.trial_process import run
from tools.viewer_client import ViewerClient, page

HTML = "<img src=x onerror=alert(1)>.png"
MANY = 100
VALUES: tuple[Any, ...] = (
    0, -1, 1.5, 1e308, float("nan"), float("inf"), "", "x" * 5000, "\x00", "<script>", None, [], {}, [[]] * 9, True,
    2**63, b"\xff" * 9, [1.0, 0.0, 0.0, 0.0], "../../x",
)  # fmt: skip
METHODS = ("GET", "POST", "PUT", "DELETE", "OPTIONS", "HEAD", "TRACE", "CONNECT", "\x00", "GET GET", "PRI")
PATHS = (
    "/", "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/document", "/capture", "/photo/0", "/photo/-1", "*", "",
    "/photo/" + "9" * 400, "//evil.example/", "/?key=", "/?key=\xff", "/?" + "a&" * 5000, "http://[", "/results",
    "/close", "/grab",
)  # fmt: skip
HEADERS = (
    "Origin: null", "Upgrade: websocket", "Connection: Upgrade", "Content-Length: 5", "Content-Length: -1",
    "Content-Length: 99999999999", "Transfer-Encoding: chunked", "no colon", "\x00: \x00",
)  # fmt: skip


def cases(seed: int, cases: int, place: Path) -> Iterator[Case]:
    """Cases, half of them for `view` and half for `annotate`."""
    yield Case("names that are HTML", names_fault(place / "names"))
    draw = random.Random(seed)
    root = write_room(place / "room")
    with viewed() as viewer, serving(root) as annotation:
        for name, port in (("view", viewer.port), ("annotate", int(annotation.server_address[1]))):
            yield Case(f"{name} from elsewhere", elsewhere_fault(port))
        for number in range(3, cases):
            what, fault = at_view(viewer, draw, number) if number % 2 else at_annotate(annotation, draw, number)
            yield Case(f"{number} {what}", fault)


def elsewhere_fault(port: int) -> str:
    """Fault if the server listens on an address that other computers can reach."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # Sends nothing; determines the external address.
        except OSError:
            return ""  # No network.
        address = probe.getsockname()[0]
    with suppress(OSError), socket.create_connection((address, port), timeout=20):
        return f"listens at {address}"
    return ""


def names_fault(place: Path) -> str:
    """Fault of pages about photographs and a capture with HTML in their names."""
    data = write_tiny_capture(place / HTML)
    for folder in ("images", "panes"):
        for path in sorted((data / folder).iterdir()):
            path.rename(path.with_name(HTML + path.name))
    file = data / "transforms.json"
    file.write_text(file.read_text().replace("images/", f"images/{HTML}"))
    out = place / "run"
    prepared = place / f"{HTML} prepared"
    told = [run(["prepare", oddly_named(place / "photographs"), "--output", prepared])]
    told += [run(["train", "splat", "--data", data, "--output", out, "--iterations", "3", "--device", "cpu"])]
    told += [
        run(["eval", out, "--device", "cpu"]),
        run(["export", out, "--output", place / "exported", "--device", "cpu"]),
    ]
    faults = [one.fault() or ("" if one.code == 0 else one.output[-300:]) for one in told]
    pages = {path: path.read_text() for path in place.rglob("*.html")}
    faults += [f"{path} has the name as HTML" for path, text in pages.items() if "<img src=x on" in text]
    reports = prepared / PAGE, out / "index.html"
    faults += [f"{path} does not have the name" for path in reports if "&lt;img src=x" not in pages.get(path, "")]
    return "; ".join(fault for fault in faults if fault)


def oddly_named(folder: Path) -> Path:
    """Writes photographs with HTML in their names, one of which is uniform and cannot be registered."""
    copy_photographs(folder)
    for path in sorted(folder.iterdir()):
        path.rename(path.with_name(f"{HTML} {path.name}"))
    write_image(folder / f"lost {HTML}", torch.full((96, 128, 3), 0.5))
    return folder


@contextmanager
def viewed() -> Iterator[Viewer]:
    """Runs a viewer of the tiny scene."""
    views = tiny_capture().train
    photographs = {view.name: lambda: torch.zeros(28, 40, 3, dtype=torch.uint8) for view in views}
    cameras = [(view.name, view.camera) for view in views]
    viewer = Viewer(ViewerState("trial", true_scene(), Planar(), cameras, photographs), "127.0.0.1", free_port())
    viewer.start()
    try:
        yield viewer
    finally:
        viewer.stop()


def at_view(viewer: Viewer, draw: random.Random, number: int) -> tuple[str, str]:
    """Tests one case at the viewer; returns its name and fault."""
    kind = draw.choice(("stranger", "messages", "messages", "long", "slow", "garbage"))
    if number in (3, 5):
        kind = "many" if number == 3 else "silent"
    with redirect_stderr(io.StringIO()) as there:
        try:
            fault = asyncio.run(asyncio.wait_for(VIEWED[kind](viewer, draw), 120)) or asyncio.run(served(viewer))
        except Exception as error:  # noqa: BLE001 - Any error means that a client was not served.
            fault = f"{type(error).__name__}: {error}"
    printed = there.getvalue()
    return f"view {kind}", fault or (printed if "Traceback" in printed else "")


async def served(viewer: Viewer) -> str:
    """Checks that a client with the link gets an image."""
    async with ViewerClient(viewer.address) as client:
        await client.picture(60)
    return ""


async def stranger(viewer: Viewer, draw: random.Random) -> str:
    """Connects with a wrong origin, host or key."""
    local = f"localhost:{viewer.port}"
    origins = (
        "http://evil.example",
        "null",
        None,
        f"https://evil.{local}",
        f"http://{local}.evil.example",
        "http://[",
        "",
    )
    hosts = (local, "evil.example", f"evil.example:{viewer.port}", "127.0.0.1.evil.example", f"{local}.evil.example")
    keys = ("", "x", viewer.access.key[:-1], viewer.access.key + "x", viewer.access.key.swapcase(), viewer.access.key)
    given: dict[str, Any] = {"origin": draw.choice(origins), "host": draw.choice(hosts), "key": draw.choice(keys)}
    if given["key"] == viewer.access.key and given["host"] == local and given["origin"] == "":
        return ""
    try:
        async with ViewerClient(viewer.address, **given):
            return f"was granted access with {given}"
    except (InvalidHandshake, ConnectionClosed, OSError, ValueError):
        return ""


async def messages(viewer: Viewer, draw: random.Random) -> str:
    """Sends fifty messages with random fields, and random values of controls."""
    async with ViewerClient(viewer.address) as client:
        await client.picture()
        for _ in range(50):
            kind = draw.choice((*MESSAGES, "ShareUrlRequest", "FileTransferPart", "GetRenderResponseMessage", "None"))
            fields = {name: draw.choice(VALUES) for name in MESSAGES.get(kind, {"uuid": 0}) if draw.random() < 0.8}
            if draw.random() < 0.3 and client.labels():
                label = draw.choice(list(client.labels()))
                await client.set(label, draw.choice([value for value in VALUES if value != 2**64]))
            elif draw.random() < 0.1:
                await client.connection.send(draw.choice(("text", b"\x91" * 999, msgspec.msgpack.encode([1]))))
            elif draw.random() < 0.5:
                await client.look(**{draw.choice(list(MESSAGES["ViewerCameraMessage"])): draw.choice(VALUES)})
            else:
                await client.send(kind, **fields)
    return ""


async def long(viewer: Viewer, draw: random.Random) -> str:
    """Sends a message that is too long."""
    async with ViewerClient(viewer.address) as client:
        with suppress(ConnectionClosed):
            await client.connection.send(bytes(LARGEST_MESSAGE * draw.choice((2, 50))))
            await asyncio.wait_for(client.connection.wait_closed(), 30)
    return "" if client.connection.close_code is not None else "it was heard"


async def slow(viewer: Viewer, draw: random.Random) -> str:
    """Requests many images without reading them, until the server disconnects."""
    async with ViewerClient(viewer.address) as client:
        client.stop_hearing()
        for step in range(30):
            await client.look(position=(0.0, 0.0, -2.0 + 0.01 * step), image_width=1920, image_height=1080)
        await asyncio.sleep(draw.uniform(0, 1))
        client.connection.transport.abort()
    return ""


async def many(viewer: Viewer, draw: random.Random) -> str:
    """Connects a hundred clients at once, each of which has to get an image."""

    async def one() -> None:
        async with ViewerClient(viewer.address) as client:
            await client.picture(100)

    results = await asyncio.gather(*(one() for _ in range(MANY)), return_exceptions=True)
    failed = [result for result in results if isinstance(result, BaseException)]
    return f"{len(failed)} of {MANY} got no picture: {failed[0]!r}" if failed else ""


async def silent(viewer: Viewer, draw: random.Random) -> str:
    """Opens a hundred silent connections, while another client requests an image."""
    writers = [(await asyncio.open_connection("127.0.0.1", viewer.port))[1] for _ in range(MANY)]
    try:
        return await served(viewer)
    finally:
        for writer in writers:
            writer.close()


async def garbage(viewer: Viewer, draw: random.Random) -> str:
    """Sends a malformed request, with or without the key."""
    has_key = draw.random() < 0.5
    cookie = f"{cookie_name(f'localhost:{viewer.port}')}={viewer.access.key}" if has_key else ""
    return answered_well(viewer.port, request(draw, viewer.port, cookie), let_in=has_key)


VIEWED = {
    "stranger": stranger, "messages": messages, "long": long, "slow": slow, "many": many, "silent": silent,
    "garbage": garbage,
}  # fmt: skip


def at_annotate(server: AnnotationServer, draw: random.Random, number: int) -> tuple[str, str]:
    """Tests one case at the annotation server, with or without the key; returns its name and fault."""
    if number in (4, 6):
        return f"annotate {'many' if number == 4 else 'silent'}", many_annotating(server, is_silent=number == 6)
    file = server.session.root / "annotations.json"
    before = file.read_bytes() if file.is_file() else b""
    port = int(server.server_address[1])
    has_key = draw.random() < 0.5
    cookie = f"{cookie_name(f'127.0.0.1:{port}')}={server.access.key}" if has_key else ""
    sent = request(draw, port, cookie)
    with redirect_stderr(io.StringIO()) as there:
        try:
            fault = answered_well(port, sent, let_in=has_key) or capture_fault(server)
        except Exception as error:  # noqa: BLE001 - Any error means that the next client was not served.
            fault = f"{type(error).__name__}: {error}"
    if (file.read_bytes() if file.is_file() else b"") != before:
        fault = fault or "the marks were changed"
    printed = there.getvalue()
    if server.is_finished:
        server.is_finished = False
    return f"annotate {'with' if has_key else 'without'} key {sent[:60]!r}", fault or (
        printed if "Traceback" in printed else ""
    )


def capture_fault(server: AnnotationServer) -> str:
    """Fault of the description of the capture that an authorised page receives."""
    cookie = f"{cookie_name(urlsplit(server.address).netloc)}={server.access.key}"
    status, _, body = page(server.address, "/capture", Cookie=cookie)
    return "" if status == 200 and "views" in json.loads(body) else f"/capture answers {status}"


def many_annotating(server: AnnotationServer, *, is_silent: bool) -> str:
    """Opens a hundred pages at once, or one page while a hundred connections stall in the middle of a save."""
    host, port = "127.0.0.1", int(server.server_address[1])
    cookie = f"{cookie_name(f'{host}:{port}')}={server.access.key}"
    begun = f"POST /document HTTP/1.1\r\nHost: {host}:{port}\r\nOrigin: http://{host}:{port}\r\nCookie: {cookie}\r\n"
    with ExitStack() as connections, ThreadPoolExecutor(MANY) as pool:
        for _ in range(MANY * is_silent):
            silent = connections.enter_context(socket.create_connection((host, port), timeout=20))
            silent.sendall(f"{begun}Content-Length: 8000000\r\n\r\n{{".encode())
        try:
            faults = list(pool.map(lambda _: capture_fault(server), range(1 if is_silent else MANY)))
        except Exception as error:  # noqa: BLE001 - Any error means that a client was not served.
            return f"{type(error).__name__}: {error}"
    return next(filter(None, faults), "")


def request(draw: random.Random, port: int, cookie: str) -> bytes:
    """Bytes that resemble a request."""
    path = draw.choice([path for path in PATHS if not (cookie and path in ("/close", "/results"))])
    lines = [f"{draw.choice(METHODS)} {path} HTTP/{draw.choice(('1.1', '1.0', '9.9', 'x'))}"]
    lines.append(f"Host: {draw.choice((f'127.0.0.1:{port}', 'evil.example', '', '[::1]', ':' * 99))}")
    lines += (
        [f"Cookie: {cookie}"] if cookie else [f"Cookie: glassplat_{port}={draw.choice(('x', '', chr(255), ';' * 99))}"]
    )
    more = [f"Origin: http://127.0.0.1:{port}", "X: " + "y" * draw.choice((10, 70_000)), *HEADERS]
    lines += draw.sample(more, draw.randint(0, 5))
    body = draw.choice(("", "{}", "[" * 5000, "null", '{"document": {}, "version": 1}', "\xff\xfe"))
    return ("\r\n".join(lines) + "\r\n\r\n" + body).encode("latin-1")


def answered_well(port: int, sent: bytes, *, let_in: bool = False) -> str:
    """Fault of the answer to a request: data without the key, or an internal error of the server."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection, suppress(ConnectionError):
        connection.sendall(sent)
        with suppress(OSError):  # The server has already answered and closed.
            connection.shutdown(socket.SHUT_WR)
        answer = b""
        while part := connection.recv(65536):
            answer += part
        status = answer.split(b" ")[1:2]
        if b"root:" in answer:
            return "was answered with a file from elsewhere"
        if status and status[0] in (b"200", b"101", b"303") and not let_in:
            return f"was answered: {answer[:100]!r}"
        if status and status[0] == b"500":
            return f"an error of the server: {answer[:300]!r}"
    return ""
