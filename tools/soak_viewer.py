"""Soak test of the viewer: many clients act at random; memory must stay constant, and all must get images.

    python -m tools.soak_viewer RUN --clients 50 --minutes 120 [--deaf 2] [--pause 0.25]

It starts `glassplat view` in a separate process and uses the protocol of viser, like a browser. Clients move cameras,
use every control of the page, drag panes, and drop connections. Deaf clients request images but never read any. At the
end all clients pause, and each one that is not deaf has to receive an image. Memory is that of the viewer process; its
slope is fitted to the second half of the time.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import random
import re
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from websockets.exceptions import ConnectionClosed

from tests.viewer.free_port import free_port
from tools.viewer_client import ViewerClient

SIZES = ((640, 480), (1280, 720), (390, 844))
LEAVES = 0.01
"""Share of the actions that drop the connection."""
BETWEEN_SAMPLES = 5.0
LAST_PICTURE = 300.0
"""Timeout in seconds for every paused client to receive an image."""
MOST_TOLD = 20
COMPLAINTS = ("Traceback", "Error", "could not be rendered")


@dataclass
class Count:
    """Counts of events."""

    pictures: int = 0
    actions: int = 0
    connections: int = 0
    refused: list[str] = field(default_factory=list)


class Looker:
    """One client, with typical and unusual actions."""

    def __init__(self, address: str, seed: int, pause: float, count: Count, *, is_deaf: bool = False) -> None:
        self._address, self._random, self._pause, self._count = address, random.Random(seed), pause, count
        self.is_deaf = is_deaf
        self._angle, self._size = self._random.uniform(0, 6.28), self._random.choice(SIZES)
        self.rests, self.pictures = False, 0

    async def live(self) -> None:
        """Connects, acts and connects again, until it is cancelled."""
        while True:
            try:
                async with ViewerClient(self._address) as client:
                    self._count.connections += 1
                    before = client.pictures
                    if self.is_deaf:
                        client.stop_hearing()
                    try:
                        await self._look(client)
                        await self._act(client)
                    finally:
                        self._count.pictures += client.pictures - before
                        if self._random.random() < 0.5:
                            client.connection.transport.abort()  # As if a laptop were closed.
            except (ConnectionClosed, OSError, TimeoutError) as error:
                self._count.refused.append(f"{type(error).__name__}: {error}")
                await asyncio.sleep(1)

    async def _act(self, client: ViewerClient) -> None:
        """Acts until it leaves; while paused, it only listens."""
        before: int | None = None
        while True:
            await asyncio.sleep(self._random.expovariate(1 / self._pause))
            if self.rests:
                if before is None:
                    before = client.pictures
                    await self._look(client)
                self.pictures = client.pictures - before
                continue
            before = None
            if self._random.random() < LEAVES:
                return
            self._count.actions += 1
            await self._random.choice((self._look, self._look, self._click, self._drag))(client)

    async def _look(self, client: ViewerClient) -> None:
        """Moves the camera on a circle around the origin."""
        self._angle += self._random.gauss(0, 0.1)
        half = self._angle / 2
        await client.look(
            wxyz=(float(np.cos(half)), 0.0, float(np.sin(half)), 0.0),
            position=(float(-2 * np.sin(self._angle)), 0.0, float(-2 * np.cos(self._angle))),
            fov=self._random.uniform(0.5, 1.5),
            image_width=self._size[0],
            image_height=self._size[1],
        )

    async def _click(self, client: ViewerClient) -> None:
        """Sets a random control of the page."""
        if not client.controls:
            return
        uuid, made = self._random.choice(list(client.controls.items()))
        properties = made["props"]
        if "options" in properties:
            value: Any = self._random.choice(properties["options"])
        elif made["type"] == "GuiButtonMessage":
            value = True
        elif made["type"] == "GuiSliderMessage":
            value = self._random.uniform(properties["min"], properties["max"])
        else:
            return
        await client.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    async def _drag(self, client: ViewerClient) -> None:
        """Moves and rotates a pane slightly."""
        if not client.gizmos:
            return
        name, made = self._random.choice(list(client.gizmos.items()))
        turn = np.array([1.0, *(self._random.gauss(0, 0.1) for _ in range(3))])
        await client.send(
            "TransformControlsUpdateMessage",
            name=name,
            owner=made.get("owner", ""),
            wxyz=(turn / np.linalg.norm(turn)).tolist(),
            position=[self._random.gauss(0, 0.5) for _ in range(3)],
        )


@dataclass
class Soaked:
    """Result of a soak test: seconds and MiB of samples, counts, and error lines of the viewer."""

    samples: list[tuple[float, float]]
    count: Count
    without_picture: int
    complaints: list[str]
    seconds_to_last: float

    @property
    def slope(self) -> float:
        """Slope of memory in MiB per hour, over the second half of the samples."""
        half = np.array(self.samples[len(self.samples) // 2 :])
        return float(3600 * np.polyfit(half[:, 0], half[:, 1], 1)[0]) if len(half) > 2 else 0.0


def resident_mib(pid: int) -> float:
    """Resident memory of a process, MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


async def soak(
    run: Path, clients: int, minutes: float, *, deaf: int = 0, pause: float = 0.25, say: Any = print
) -> Soaked:
    """Starts a viewer and clients, of which some are deaf, waits, and stops them all."""
    port, count = free_port(), Count()
    with tempfile.TemporaryDirectory() as kept, tempfile.TemporaryFile("w+") as log:
        command = ["-m", "glassplat", "view", str(run), "--port", str(port), "--output", kept]
        viewer = await asyncio.create_subprocess_exec(sys.executable, *command, stdout=log, stderr=log)
        try:
            address = await asyncio.wait_for(printed_address(log, viewer), LAST_PICTURE)
            browsers = [Looker(address, seed, pause, count, is_deaf=seed < deaf) for seed in range(clients)]
            tasks = [asyncio.create_task(browser.live()) for browser in browsers]
            samples = await sampled(viewer.pid, 60 * minutes, count, say)
            for browser in browsers:
                browser.rests = True
            begun = time.monotonic()
            await asyncio.sleep(4 * pause)
            hearing = [browser for browser in browsers if not browser.is_deaf]
            while any(not one.pictures for one in hearing) and time.monotonic() - begun < LAST_PICTURE:
                await asyncio.sleep(0.5)
            seconds = time.monotonic() - begun
            missing = sum(not one.pictures for one in hearing)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            with contextlib.suppress(ProcessLookupError):
                viewer.terminate()
            await viewer.wait()
        log.seek(0)
        complaints = [line.strip() for line in log if any(word in line for word in COMPLAINTS)]
    return Soaked(samples, count, missing, complaints, seconds)


async def printed_address(log: IO[str], viewer: asyncio.subprocess.Process) -> str:
    """Address printed by the viewer; raises RuntimeError if it ends before."""
    while viewer.returncode is None:
        found = re.search(r"viewer: (http\S+)", os.pread(log.fileno(), 1_000_000, 0).decode())
        if found:
            return found[1]
        await asyncio.sleep(0.2)
    raise RuntimeError("the viewer ended before it listened; try `glassplat view` with the same run")


async def sampled(pid: int, seconds: float, count: Count, say: Any) -> list[tuple[float, float]]:
    """Samples memory over time, and prints a line each minute."""
    begun, samples, said = time.monotonic(), list[tuple[float, float]](), 0
    while (now := time.monotonic() - begun) < seconds:
        samples.append((now, resident_mib(pid)))
        if now >= 60 * said:
            said += 1
            say(
                f"{now / 60:6.1f} min {samples[-1][1]:7.0f} MiB {count.pictures:8d} pictures {count.actions:8d} actions"
            )
        await asyncio.sleep(min(BETWEEN_SAMPLES, seconds / 20))
    return samples


def main() -> int:
    """Runs the soak test and prints the result; returns 1 if a client got no image or the viewer reported errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=120)
    parser.add_argument("--deaf", type=int, default=0, help="number of clients that never read an image")
    parser.add_argument("--pause", type=float, default=0.25, help="mean seconds between two actions of a client")
    options = parser.parse_args()
    found = asyncio.run(
        soak(
            options.run,
            options.clients,
            options.minutes,
            deaf=options.deaf,
            pause=options.pause,
            say=partial(print, flush=True),
        )
    )
    first, last = found.samples[len(found.samples) // 2][1], found.samples[-1][1]
    print(
        f"{found.count.connections} connections, {found.count.actions} actions, {found.count.pictures} pictures; "
        f"half-way {first:.0f} MiB, at the end {last:.0f}, slope {found.slope:+.1f} MiB/h; all at rest: "
        f"{found.without_picture} of {options.clients - options.deaf} without an image after "
        f"{found.seconds_to_last:.1f} s"
    )
    for line, times in Counter([*found.complaints, *found.count.refused]).most_common(MOST_TOLD):
        print(f"{times} times: {line}")
    return 1 if found.without_picture or found.complaints else 0


if __name__ == "__main__":
    sys.exit(main())
