"""The page of `ohmskin view` in headless Chromium: frames drawn per second, and what one costs browser and server.

Each array is emulated, served and shown by processes of their own, started as a user would start them. Costs are
processor times, which other work on the machine changes little; frames per second are real.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..common.config import write_toml
from ..common.extras import install_command
from ..errors import LinkError, MissingExtra
from ._driver import design
from .harness import column

FRAME_RATE_HZ = 60.0
WARM_UP_S = 3.0
SECONDS = 8.0
CHROMIUM = "/usr/bin/chromium"


HEAD = (
    f"a board at {FRAME_RATE_HZ:g} Hz, the page in headless Chromium without a graphics processor; "
    "ms of processor time per frame"
)


@dataclass(frozen=True)
class Row:
    """One array."""

    size: int = field(metadata=column("cells", "{0} x {0}"))
    """of the N x N array"""
    board_hz: float = field(metadata=column("taken/s", "{:.1f}"))
    """frames per second that reached the server"""
    drawn_hz: float = field(metadata=column("drawn/s", "{:.1f}"))
    """frames per second that the browser drew"""
    draw_ms: float = field(metadata=column("drawing", "{:.2f}"))
    """mean time of the page's own drawing code, by the browser's clock"""
    main_thread_ms: float = field(metadata=column("main thread", "{:.2f}"))
    """processor time of the browser's main thread per drawn frame: messages, drawing, layout"""
    server_ms: float = field(metadata=column("server", "{:.2f}"))
    """processor time of `ohmskin view` per frame that reached it: bytes to kPa, contacts, message, WebSocket"""


def view(sizes: Iterable[int], *, seconds: float = SECONDS) -> Iterator[Row]:
    """Measure arrays of several sizes at 60 Hz.

    Raises:
        MissingExtra: playwright is not installed.
        LinkError: a process that is measured did not start.

    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise MissingExtra(f"the browser is driven by playwright: {install_command('test')}") from error
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        )
        for size in sizes:
            with tempfile.TemporaryDirectory() as folder:
                scene = Path(folder) / "scene.toml"
                write_toml(scene, _scene(size))
                link = Path(folder) / "skin"
                with (
                    _started("emulate", str(scene), "--link", str(link)),
                    _started("view", str(link), "--no-browser", "--port", "0") as (server, url),
                ):
                    page = browser.new_page(viewport={"width": 1280, "height": 860})
                    page.goto(url)
                    yield measured_page(page, server.pid, size, seconds)
                    page.close()
        browser.close()


def _scene(size: int) -> dict[str, Any]:
    """A finger that slides to and fro over the whole skin, and a stylus that taps."""
    middle, far = size / 2, size - 2.0
    return {
        "skin": {"design": design(size, "inverting-amplifier", "ground", 12).model_dump(exclude_defaults=True)},
        "board": {"frame_rate": FRAME_RATE_HZ, "noise": 0.0005},
        "contact": [
            {
                "bump": {"sigma_cells": max(size / 16, 0.7)},
                "path_cells": [[0.0, 1.0, 1.0], [2.0, middle, far], [4.0, 1.0, 1.0]],
                "path_period": 4.0,
                "load_kpa": [[0.0, 0.0], [1.0, 0.0], [1.2, 12.0]],
            },
            {
                "disc": {"center": [far, far / 2], "radius_cells": max(size / 20, 0.8)},
                "taps": {"load_kpa": 9.0, "every_s": 0.8, "hold_s": 0.2, "first_s": 1.0},
            },
        ],
    }


@contextmanager
def _started(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A command of ohmskin while the block lasts, and the first line that it prints."""
    process = subprocess.Popen([sys.executable, "-m", "ohmskin", *arguments], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        if not line:
            raise LinkError(f"ohmskin {arguments[0]} did not start")
        yield process, line
    finally:
        process.terminate()
        process.communicate()


def measured_page(page: Any, server_pid: int, size: int, seconds: float) -> Row:
    """Measure a page that is open, of a server whose process has the number ``server_pid``."""
    browser = page.context.new_cdp_session(page)
    browser.send("Performance.enable", {"timeDomain": "threadTicks"})
    while not page.evaluate("Boolean(globalThis.ohmskin?.frame)"):
        page.wait_for_timeout(50)
    for k in range(3):
        page.evaluate(f"ohmskin.choose({(size // 2) * size + k})")
    page.wait_for_timeout(1e3 * min(WARM_UP_S, seconds))
    before = _counters(page, browser, server_pid)
    page.wait_for_timeout(1e3 * seconds)
    after = _counters(page, browser, server_pid)
    while after["drawn"] == before["drawn"] or after["frames"] == before["frames"]:  # a machine that was kept busy
        page.wait_for_timeout(50)
        after = _counters(page, browser, server_pid)
    change = {name: after[name] - before[name] for name in before}
    return Row(
        size=size,
        board_hz=change["frames"] / change["clock_s"],
        drawn_hz=change["drawn"] / change["clock_s"],
        draw_ms=change["draw_ms"] / change["drawn"],
        main_thread_ms=1e3 * change["main_s"] / change["drawn"],
        server_ms=1e3 * change["server_s"] / change["frames"],
    )


def _counters(page: Any, browser: Any, server_pid: int) -> dict[str, float]:
    drawn, draw_ms, frames, clock_ms = page.evaluate(
        "[ohmskin.drawn, ohmskin.drawn_ms, ohmskin.frame.number, performance.now()]"
    )
    metrics = {one["name"]: one["value"] for one in browser.send("Performance.getMetrics")["metrics"]}
    # Fields 14 and 15 of stat: processor time in user and kernel mode, in ticks.
    fields = Path(f"/proc/{server_pid}/stat").read_text().rpartition(")")[2].split()
    return {
        "drawn": drawn,
        "draw_ms": draw_ms,
        "frames": frames,
        "clock_s": clock_ms / 1e3,
        "main_s": metrics["TaskDuration"],
        "server_s": (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"),
    }
