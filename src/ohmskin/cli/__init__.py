"""The command ``ohmskin``: one module per command, imported only when that command is called.

Exit codes: 0 done; 1 a requirement fails (``verify``); 2 bad input, a missing extra, or a port error, with one
line on standard error and nothing half-written; 3 something could not be run (``verify``); 130 interrupted.
"""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from typing import Any

import click

from .. import __version__
from ..errors import OhmskinError

# name -> one-line help. The module cli/NAME.py holds a click command called `command`.
COMMANDS = {
    "scan": "Read one frame of cells through a readout design.",
    "netlist": "Write one scan step as a SPICE netlist.",
    "verify": "Verify a readout design: report.html, report.json, junit.xml.",
    "emulate": "Run a virtual scan board on a pty or TCP port.",
    "fit": "Identify a cell and calibrate its estimators from a recording.",
    "estimate": "Estimate pressure from a recording of resistance.",
    "bench": "Measure speed against error: all methods and their peers.",
}


class _LazyGroup(click.Group):
    """A group that imports a command's module when it is called, so that ``--help`` stays instant."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = importlib.import_module(f".{cmd_name}", __name__).command
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            near = difflib.get_close_matches(args[0], COMMANDS, n=1, cutoff=0.0)[0]
            raise click.UsageError(f"no command '{args[0]}'; the nearest is '{near}'")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="ohmskin")
def ohmskin() -> None:
    """Readout, emulation, driver and verification of resistive robot skins."""


def main(args: list[str] | None = None) -> None:
    """Run the command line and exit; every :class:`OhmskinError` becomes one line and exit code 2."""
    sys.exit(run(args))


def run(args: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    try:
        result: Any = ohmskin.main(args=args, prog_name="ohmskin", standalone_mode=False)
    except OhmskinError as error:
        click.echo(f"ohmskin: {' '.join(str(error).split())}", err=True)
        return 2
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 2
    except click.ClickException as error:
        click.echo(f"ohmskin: {' '.join(error.format_message().split())}", err=True)
        return 2
    except click.exceptions.Exit as error:
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("ohmskin: interrupted", err=True)
        return 130
    except OSError as error:
        # Files are the library's to open, and its errors are caught above: what is left is standard output.
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  # so that its flush at exit does not fail again
        click.echo(f"ohmskin: standard output: {error.strerror or error}", err=True)
        return 2
    return result if isinstance(result, int) else 0
