"""Endurance test: emulator, driver, recorder and page together, and many hosts that come and go, without growth.

``python -m ohmskin.bench.soak SCENE.toml --frames 300000 --hosts 2000`` prints a line for each part. It ends with 1 if
one of them failed: a frame is missing or corrupt, or memory, threads or open files have grown. The board's clock is the
fast one, and the driver lossless: the board waits for the slowest of driver, recorder and page, so that no frame may be
missing, however busy the machine is.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import socket
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, cast

import click
import numpy as np

from ..driver import Skin
from ..emulator import PtyPort, Scene, TcpPort, running
from ..errors import OhmskinError
from ..view import LiveSource, serve

PATIENCE_S = 3600.0
"""a busy machine is no failure"""

MOST_GROWTH_KB = 8192
"""memory that a run may take more at its end than after its first tenth: what the allocator keeps"""


@dataclass(frozen=True)
class Endured:
    """What came of many frames."""

    arrived: int
    missing: int
    """frames lost on the way, and stretches that were corrupt"""
    recorded: int
    shown: int
    """frames that a browser got; it asks for the next one when it has one"""
    growth_kb: int
    """of memory, since the first tenth of the frames"""
    threads: int
    files: int
    """threads and files that are there in the end, and were not in the beginning"""


def soak_frames(scene: Scene, frames: int, seed: int = 0) -> Endured:
    """Carry frames from an emulated board through driver, recorder and page, all in this process.

    Raises:
        MissingExtra: mcap or websockets is not installed.

    """
    before = threading.active_count(), _open_files()
    arrived = lost = early_kb = 0
    with tempfile.TemporaryDirectory() as folder, PtyPort() as port, running(scene, port, clock="fast", seed=seed):
        path = Path(folder) / "soak.mcap"
        skin = Skin.open(port.name, delivery="lossless", record=path, timeout=PATIENCE_S)
        with _browser(LiveSource(skin)) as browser:
            for frame in islice(skin, frames):  # the page shares this place in the stream: lossless waits for it
                arrived += 1
                lost += frame.lost_before or 0
                if not early_kb and arrived >= frames // 10:
                    early_kb = resident_kb()
            growth_kb = resident_kb() - early_kb
            stats, recorder = skin.stats(), skin.recorder
        assert recorder is not None
        if recorder.error is not None:
            raise recorder.error
        recorded = recorder.frames
    return Endured(
        arrived,
        lost + stats.corrupt,
        recorded,
        browser.shown,
        growth_kb,
        threading.active_count() - before[0],
        _open_files() - before[1],
    )


class _Browser:
    """Asks the page of a skin for one frame after the other."""

    def __init__(self) -> None:
        self.shown = 0

    def follow(self, url: str) -> None:
        """Until the page ends."""
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        frames = url.replace("http", "ws", 1) + "frames"
        after = -1
        with (
            contextlib.suppress(ConnectionClosed),
            connect(frames, origin=cast("Any", url.rstrip("/")), proxy=None, max_size=None) as page,
        ):
            page.send(json.dumps({"do": "next", "after": after}))
            for message in page:
                if isinstance(message, bytes):
                    self.shown += 1
                    after = int.from_bytes(message[4:8], "little")
                    page.send(json.dumps({"do": "next", "after": after}))


@contextmanager
def _browser(source: LiveSource) -> Iterator[_Browser]:
    """A page of a source, in a thread of its own, and a browser that looks at it."""
    browser, ready = _Browser(), threading.Event()
    addresses: list[str] = []
    loop, stop = asyncio.new_event_loop(), asyncio.Event()

    async def show() -> None:
        try:
            with source:
                async with serve(source) as page:
                    addresses.append(page.url)
                    ready.set()
                    await stop.wait()
        finally:
            ready.set()
            await loop.shutdown_default_executor()

    serving = threading.Thread(target=loop.run_until_complete, args=(show(),))
    serving.start()
    ready.wait()
    following = threading.Thread(target=browser.follow, args=tuple(addresses))
    following.start()
    try:
        yield browser
    finally:
        loop.call_soon_threadsafe(stop.set)
        serving.join()
        following.join()
        loop.close()


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def soak_hosts(scene: Scene, hosts: int, seed: int = 0) -> tuple[int, int]:
    """Let hosts come and go over TCP: silent ones, ones that leave in the middle of a packet, ones that send noise.

    Returns:
        Hosts that the board has sent something, of a third that waited for it; and files that are open in the end and
        were not in the beginning.

    """
    random = np.random.default_rng(seed)
    before = _open_files()
    port = TcpPort.at(":0")
    address = port.name.removeprefix("socket://").rsplit(":", 1)
    served = 0
    with running(scene, port, seed=seed):
        for number in range(hosts):
            with socket.create_connection((address[0], int(address[1])), timeout=60) as host:
                match number % 3:
                    case 1:
                        served += bool(host.recv(int(random.integers(1, 500))))
                    case 2:
                        host.sendall(random.bytes(int(random.integers(1, 500))))
    return served, _open_files() - before


def resident_kb() -> int:
    """Memory of this process in kB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


@click.command()
@click.argument("scene", metavar="SCENE.toml", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--frames", default=300_000, show_default=True, help="That go through all of them.")
@click.option("--hosts", default=2_000, show_default=True, help="That come and go.")
@click.option("--seed", default=0, show_default=True)
def main(scene: Path, frames: int, hosts: int, seed: int) -> None:
    """Carry frames through emulator, driver, recorder and page, and let hosts come and go; exits with 1 on a fault."""
    played = Scene.load(scene)
    came = soak_frames(played, frames, seed)
    click.echo(
        f"{came.arrived} frames arrived, {came.missing} missing or corrupt, {came.recorded} recorded, {came.shown} "
        f"shown; memory grew by {came.growth_kb} kB, {came.threads} threads and {came.files} files are left"
    )
    served, left = soak_hosts(played, hosts, seed)
    click.echo(f"{hosts} hosts came and went, {served} of them were sent something, {left} files are still open")
    whole = came.arrived == frames and came.missing == 0 and came.shown > 0 and came.recorded > 0
    tidy = came.growth_kb <= MOST_GROWTH_KB and not (came.threads > 0 or came.files > 0 or left > 0)
    raise SystemExit(int(not (whole and tidy and served >= hosts // 3)))


if __name__ == "__main__":
    try:
        main()
    except OhmskinError as error:
        sys.exit(str(error))
