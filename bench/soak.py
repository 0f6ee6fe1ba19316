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
from dataclasses import dataclass, replace
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
    growth_kb: int
    """of memory, since the first tenth of the frames"""
    shown: int = 0
    """frames that a browser got; it asks for the next one when it has one"""
    threads: int = 0
    files: int = 0
    """threads and files that are there in the end, and were not in the beginning"""


def soak_frames(scene: Scene, frames: int, seed: int = 0) -> Endured:
    """Carry frames from an emulated board through driver, recorder and page, all in this process.

    Raises:
        MissingExtra: mcap or websockets is not installed.

    """
    threads, files = threading.active_count(), _open_files()
    with tempfile.TemporaryDirectory() as folder, PtyPort() as port, running(scene, port, clock="fast", seed=seed):
        path = Path(folder) / "soak.mcap"
        skin = Skin.open(port.name, delivery="lossless", record=path, timeout=PATIENCE_S)
        found, shown = asyncio.run(_carried(skin, frames))
    return replace(found, shown=shown, threads=threading.active_count() - threads, files=_open_files() - files)


async def _carried(skin: Skin, frames: int) -> tuple[Endured, int]:
    """What a reader of the skin got, beside a page at which a browser looks, and how many frames the browser got."""
    with LiveSource(skin) as source:
        async with serve(source) as page:
            browser = asyncio.create_task(_followed(page.url))
            found = await asyncio.to_thread(_taken, skin, frames)
    return found, await browser


def _taken(skin: Skin, frames: int) -> Endured:
    arrived = lost = early_kb = 0
    for frame in islice(skin, frames):  # the page shares this place in the stream: lossless waits for it
        arrived += 1
        lost += frame.lost_before or 0
        if not early_kb and arrived >= frames // 10:
            early_kb = resident_kb()
    recorder = skin.recorder
    assert recorder is not None
    if recorder.error is not None:
        raise recorder.error
    return Endured(arrived, lost + skin.stats().corrupt, recorder.frames, resident_kb() - early_kb)


async def _followed(url: str) -> int:
    """Ask a page for one frame after the other until it ends; how many came."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import ConnectionClosed

    shown, after = 0, -1
    with contextlib.suppress(ConnectionClosed):
        async with connect(
            url.replace("http", "ws", 1) + "frames", origin=cast("Any", url.rstrip("/")), proxy=None, max_size=None
        ) as page:
            await page.send(json.dumps({"do": "next", "after": after}))
            async for message in page:
                if isinstance(message, bytes):
                    shown += 1
                    after = int.from_bytes(message[4:8], "little")
                    await page.send(json.dumps({"do": "next", "after": after}))
    return shown


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
