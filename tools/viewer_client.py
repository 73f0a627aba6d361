"""A client of `glassplat view` without a browser, which can use the protocol of viser correctly and incorrectly.

It connects with any given origin, host and key, and sends any given message.
"""

from __future__ import annotations

import asyncio
from http.client import HTTPConnection
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec.msgpack
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect

from glassplat.access import cookie_name

CONTROLS = (
    "GuiDropdownMessage",
    "GuiSliderMessage",
    "GuiButtonMessage",
    "GuiButtonGroupMessage",
    "GuiTextMessage",
    "GuiCheckboxMessage",
)


class ViewerClient:
    """One connection to a viewer; use it in an `async with` statement.

    Attributes:
        pictures: number of received images of the scene.
        controls: messages that created controls, by their uuid.
        gizmos: messages that created gizmos on panes, by their name.
        removed: uuids of removed controls and folders.
        notes: titles and texts of notifications.
    """

    def __init__(self, address: str, *, origin: str | None = "", host: str = "", key: str | None = None) -> None:
        """Parses an address as the command prints it; by default, origin, host and key are taken from it."""
        parts = urlsplit(address)
        self.netloc = parts.netloc
        self._origin, self._host = f"http://{parts.netloc}" if origin == "" else origin, host or parts.netloc
        self._key = parse_qs(parts.query).get("key", [""])[0] if key is None else key
        self.pictures = 0
        self.controls: dict[str, dict[str, Any]] = {}
        self.gizmos: dict[str, dict[str, Any]] = {}
        self.removed: list[str] = []
        self.notes: list[str] = []

    async def __aenter__(self) -> ViewerClient:
        """Connects; raises InvalidStatus of websockets if access is denied."""
        headers = {"Cookie": f"{cookie_name(self._host)}={self._key}"} if self._key else {}
        name, _, port = self.netloc.partition(":")
        self.connection: ClientConnection = await connect(
            f"ws://{self._host}/",
            host=name,
            port=int(port),
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            origin=self._origin,  # type: ignore[arg-type]
            additional_headers=headers,
            max_size=None,
            compression=None,
            open_timeout=60,
        )
        self._hearing = asyncio.create_task(self._hear())
        return self

    async def __aexit__(self, *unused: object) -> None:
        self._hearing.cancel()
        await asyncio.gather(self._hearing, return_exceptions=True)
        await self.connection.close()

    def stop_hearing(self) -> None:
        """Stops reading, so that messages from the server pile up."""
        self._hearing.cancel()

    async def send(self, kind: str, **fields: Any) -> None:
        """Sends one message."""
        await self.connection.send(msgspec.msgpack.encode({"type": kind, **fields}))

    async def look(self, **changes: Any) -> None:
        """Sends a camera in front of the origin, with the given fields replaced."""
        usual: dict[str, Any] = {
            "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, -2.0), "fov": 1.0, "near": 0.01, "far": 1000.0,
            "image_height": 240, "image_width": 320, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, -1.0, 0.0),
        }  # fmt: skip
        await self.send("ViewerCameraMessage", **usual | changes)

    async def set(self, label: str, value: Any, seconds: float = 60) -> None:
        """Sets the control with the given label once it exists; raises TimeoutError if it does not appear."""
        async with asyncio.timeout(seconds):
            while (uuid := self.labels().get(label)) is None:
                await asyncio.sleep(0.02)
        await self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def labels(self) -> dict[str, str]:
        """Uuids of controls by their labels."""
        return {str(made["props"].get("label")): uuid for uuid, made in self.controls.items()}

    async def picture(self, seconds: float = 60) -> None:
        """Sends a camera and waits for one more image; raises TimeoutError if none arrives."""
        before = self.pictures
        await self.look()
        async with asyncio.timeout(seconds):
            while self.pictures == before:
                await asyncio.sleep(0.02)

    async def _hear(self) -> None:
        unpack = zstandard.ZstdDecompressor()
        async for data in self.connection:
            assert isinstance(data, bytes)
            size, packed = (int.from_bytes(data[at : at + 8], "little") for at in (0, 8))
            for message in msgspec.msgpack.decode(unpack.decompress(data[16 : 16 + packed], size))["messages"]:
                self._learn(message)

    def _learn(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "BackgroundImageMessage":
            self.pictures += message["rgb_data"] is not None  # The first message of viser has no image.
        elif kind in CONTROLS:
            self.controls[message["uuid"]] = message
        elif kind == "GuiRemoveMessage":
            self.removed.append(message["uuid"])
        elif kind == "TransformControlsMessage":
            self.gizmos[message["name"]] = message
        elif kind == "NotificationShowMessage":
            self.notes.append(f"{message['props']['title']}: {message['props']['body']}")


def page(address: str, path: str = "/", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of a page, without following redirects."""
    parts = urlsplit(address)
    connection = HTTPConnection(parts.netloc, timeout=30)
    try:
        connection.putrequest("GET", path, skip_host=True)
        for name, value in ({"Host": parts.netloc} | headers).items():
            if value:
                connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        return response.status, dict(response.getheaders()), response.read()
    finally:
        connection.close()
