"""``ohmskin new-tests``: an example suite of hardware-in-the-loop tests to copy."""

from __future__ import annotations

from importlib.util import find_spec

import click

from ..common.extras import install_command
from ..hil import write_suite
from . import arguments


@click.command(epilog=arguments.example("ohmskin new-tests skin-tests"))
@click.argument("folder", metavar="DIR")
def command(folder: str) -> None:
    """Write an example suite for pytest into DIR. It passes at once against the emulated board."""
    for path in write_suite(folder):
        click.echo(path)
    click.echo(f"run it: pytest {folder}")
    if find_spec("pytest") is None:
        click.echo(f"pytest is not installed: {install_command('hil')}")
