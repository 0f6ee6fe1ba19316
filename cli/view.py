"""``ohmskin view``: a skin in the browser, live or from a recording."""

from __future__ import annotations

import asyncio
import math
import threading
import webbrowser
from collections.abc import Callable, Sequence
from typing import Any

import click

from ..emulator import Stop, stop_on_signals
from ..view import LiveSource, RecordedSource, Source, serve
from . import arguments
from ._skin_options import SkinOptions, is_emulated_here, skin_options

USUAL_PORT = 8700
"""a bookmark stays right from day to day; any other port where this one is in use"""


_page_options = (
    click.option(
        "--port", type=click.IntRange(0, 65535), metavar="N", help=f"TCP port; 0: any. [{USUAL_PORT} if free]"
    ),
    click.option(
        "--host",
        default="127.0.0.1",
        show_default=True,
        metavar="ADDRESS",
        help="Where to listen. Other machines can then see the page, if they know the token in its address.",
    ),
    click.option("--no-browser", is_flag=True, help="Print the address, and open no browser."),
)


def page_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of the page."""
    for option in reversed(_page_options):
        command = option(command)
    return command


@click.command(
    epilog=arguments.example(
        "ohmskin view /dev/ttyACM0",
        "ohmskin view scene.toml --no-browser",
        "ohmskin view press.mcap --host 0.0.0.0 --port 8080",
    )
)
@click.argument("what", metavar="PORT|SCENE.toml|FILE.mcap...", nargs=-1, required=True)
@page_options
@skin_options()
def command(what: tuple[str, ...], port: int | None, host: str, no_browser: bool, options: SkinOptions) -> int:
    """Show a skin in the browser: the board at PORT, the emulated board of SCENE.toml, or a recording.

    Several of a kind are the boards of one skin. The page has a heat map, contacts, pressures over time, the state of
    the link, and a button for tare; for a recording a slider. It needs no internet. Ctrl-C ends it.
    """
    return show(what, options, port, host, open_browser=not no_browser)


def show(what: Sequence[str], options: SkinOptions, port: int | None, host: str, *, open_browser: bool) -> int:
    """Serve the page of a skin until a signal; returns the exit code."""
    with stop_on_signals() as stop:
        # The page waits for a board that is away, however long.
        skin = options.open(what, reconnect=math.inf)
        title = " + ".join(f"{one} (emulated)" if is_emulated_here(one) else one for one in what)
        source: Source = RecordedSource(skin) if skin.recorded_s is not None else LiveSource(skin, name=title)
        ports = [USUAL_PORT, 0] if port is None else [port]
        asyncio.run(_show(source, host, ports, stop, open_browser=open_browser))
        return 0 if stop.signal is None else 128 + stop.signal


async def _show(source: Source, host: str, ports: Sequence[int], stop: Stop, *, open_browser: bool) -> None:
    """Serve the page until ``stop``."""
    stopped, loop = asyncio.Event(), asyncio.get_running_loop()
    stop.then = lambda: loop.call_soon_threadsafe(stopped.set)
    if stop.is_set():
        stopped.set()
    with source:
        async with serve(source, host=host, ports=ports) as page:
            click.echo(page.url)
            if open_browser:
                # In a thread that nobody waits for: a browser in the terminal returns when it is closed.
                threading.Thread(target=_open_browser, args=(page.url,), daemon=True).start()
            await stopped.wait()


def _open_browser(url: str) -> None:
    if not webbrowser.open(url):
        click.echo("ohmskin: no browser could be opened; open this address in one", err=True)
