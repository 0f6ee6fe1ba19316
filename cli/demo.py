"""``ohmskin demo``: the shipped scene in the browser, without hardware and outside a checkout."""

from __future__ import annotations

import click

from . import arguments
from ._skin_options import SkinOptions
from .view import page_options, show


@click.command(epilog=arguments.example("ohmskin demo", "ohmskin demo --port 8080 --no-browser"))
@page_options
def command(port: int | None, host: str, no_browser: bool) -> int:
    """Show an emulated skin in the browser: at rest for five seconds, then fingers, taps and a palm.

    The same skin in Python: Skin.open("ohmskin://demo").
    """
    return show(["ohmskin://demo"], SkinOptions(), port, host, open_browser=not no_browser)
