"""The page of `ohmskin view` for tests: served in a thread, and opened in headless Chromium."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from needs import need
from patience import Patience
from playwright.sync_api import Browser, Page, Playwright, expect

from ohmskin.view import Source, serve

CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PATIENCE_MS = 60_000
"""a busy machine is no failure"""


def start(playwright: Playwright) -> Browser:
    """Debian's Chromium."""
    need(None if CHROMIUM.exists() else f"{CHROMIUM} is not there: apt-get install chromium")
    expect.set_options(timeout=PATIENCE_MS)
    return playwright.chromium.launch(executable_path=str(CHROMIUM), args=list(ARGUMENTS))


@contextmanager
def served(source: Source, **options: Any) -> Iterator[str]:
    """The address of the page of a source, which begins and is closed here."""
    ready, addresses, failures = threading.Event(), [], []
    loop, stop = asyncio.new_event_loop(), asyncio.Event()

    async def show() -> None:
        with source:
            async with serve(source, **options) as page:
                addresses.append(page.url)
                ready.set()
                await stop.wait()

    def run() -> None:
        try:
            loop.run_until_complete(show())
        except Exception as error:
            failures.append(error)
        finally:
            ready.set()
            loop.run_until_complete(loop.shutdown_default_executor())
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    ready.wait()
    try:
        if addresses:
            yield addresses[0]
    finally:
        if not failures:
            loop.call_soon_threadsafe(stop.set)
        thread.join()
    if failures:
        raise failures[0]


@contextmanager
def opened(browser: Browser, url: str, **options: Any) -> Iterator[Page]:
    """The page in a tab, with its first frame drawn. Nothing may go wrong on it, and no request may leave the host."""
    context = browser.new_context(**options)
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: None if request.url.startswith(url) else wrong.append(request.url))
    page.on("websocket", lambda socket: None if socket.url == _socket(url) else wrong.append(socket.url))
    page.goto(url)
    until(page, "Boolean(globalThis.ohmskin?.frame)")
    try:
        yield page
        assert not wrong
    finally:
        context.close()


def _socket(url: str) -> str:
    return url.replace("http", "ws", 1) + "frames"


def until(page: Page, condition: str, argument: Any = None) -> None:
    """Wait until a condition holds on the page. Playwright's own way needs eval(), which the page forbids."""
    patience = Patience(PATIENCE_MS / 1e3)
    while not page.evaluate(condition, argument):
        patience.spend(condition)
        page.wait_for_timeout(20)


def paused(page: Page) -> dict[str, Any]:
    """Stop the page at a frame, and return that frame as the page has it."""
    if page.get_attribute("#pause", "aria-pressed") != "true":
        page.click("#pause")
    until(page, "ohmskin.paused && !ohmskin.painting && !ohmskin.hurry && !ohmskin.timer")
    return shown(page)


def shown(page: Page) -> dict[str, Any]:
    """The frame that the page shows; NaN as null."""
    frame: dict[str, Any] = page.evaluate(
        """() => Object.fromEntries(Object.entries(ohmskin.frame).map(([name, value]) =>
            [name, ArrayBuffer.isView(value) ? Array.from(value, (one) => (one === one ? one : null)) : value]))"""
    )
    return frame


def colours_of_cells(page: Page, canvas: str) -> list[set[tuple[int, ...]]]:
    """The colours on a canvas within each cell, without its edge: (red, green, blue, alpha)."""
    found = page.evaluate(
        """(canvas) => {
            const {map, frame} = ohmskin;
            const context = document.getElementById(canvas).getContext("2d");
            return Array.from(frame.counts, (_, index) => {
                const [x, y] = map.corner(index);
                const {data} = context.getImageData(x + 2, y + 2, map.side - 4, map.side - 4);
                return [...new Set(new Uint32Array(data.buffer))];
            });
        }""",
        canvas,
    )
    return [{tuple(colour.to_bytes(4, "little")) for colour in cell} for cell in found]
