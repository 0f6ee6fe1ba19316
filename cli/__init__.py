"""The command ``ohmskin``: one module per command, imported only when that command is called.

Every error is one line on standard error. The exit code says what happened:

=====  ============================================================================================
0      done
1      a requirement fails (``verify``)
2      bad input, a missing extra, a port error, or an output that cannot be written
3      something could not be run (``verify``)
70     a defect of ohmskin; ``--debug`` shows the traceback
130    interrupted (128 + the number of the signal: 129 hung up, 143 terminated)
141    the reader of standard output went away
=====  ============================================================================================
"""

from __future__ import annotations

import difflib
import errno
import importlib
import logging
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any

import click
from click.shell_completion import shell_complete

from .. import __version__
from ..common import signals
from ..common.system import ENDING_SIGNALS
from ..common.text import one_line, shortened
from ..errors import OhmskinError
from . import _streams

# name -> one-line help. The module cli/NAME.py (`_` for `-`) holds a click command called `command`.
COMMANDS = {
    "scan": "Read one frame of cells through a readout design.",
    "netlist": "Write one scan step as a SPICE netlist.",
    "import": "Read a board's KiCad netlist into a design.",
    "verify": "Verify a readout design: report.html, report.json, junit.xml.",
    "explore": "Vary a design: the Pareto front, and what must change.",
    "emulate": "Run a virtual scan board on a pty or TCP port.",
    "record": "Record a skin: every byte, and frames for viewers.",
    "replay": "Play a recording on a port that any program can open.",
    "demo": "Show the shipped scene in the browser, without hardware.",
    "view": "Show a skin in the browser, live or from a recording.",
    "export": "Convert a recording to arrays or tables.",
    "calibrate": "Calibrate the cells of a skin by presses with known loads.",
    "score": "Compare a client's recording with the emulator's truth.",
    "fit": "Identify a cell and calibrate its estimators from a recording.",
    "estimate": "Estimate pressure from a recording of resistance.",
    "bench": "Measure speed against error: all methods and their peers.",
    "new-tests": "Write an example suite of tests for a skin, for pytest.",
    "doctor": "Look at the installation and the serial ports, and say how to mend them.",
}

BAD_INPUT, DEFECT, BROKEN_PIPE = 2, 70, 128 + 13
LONGEST_WORD = 200
"""characters of an argument that a message repeats"""
_COMPLETE = "_OHMSKIN_COMPLETE"
"""the variable by which a shell asks for completions, as click's documentation names it"""

_debug = click.Option(
    ["--debug"],
    is_flag=True,
    expose_value=False,
    callback=lambda ctx, option, given: ctx.find_root().ensure_object(dict).update(debug=True) if given else None,
    help="Show the traceback of an error.",
)


class _LazyGroup(click.Group):
    """A group that imports a command's module when it is called, so that ``--help`` stays instant."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = importlib.import_module(f".{cmd_name.replace('-', '_')}", __name__).command
        assert isinstance(command, click.Command)
        if _debug not in command.params:
            command.params.append(_debug)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS and not args[0].startswith("-") and not ctx.resilient_parsing:
            near = difflib.get_close_matches(args[0], COMMANDS, n=1, cutoff=0.0)[0]
            raise click.UsageError(f"no command '{args[0]}'; the nearest is '{near}'")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(
    cls=_LazyGroup,
    params=[_debug],
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: ohmskin verify design.toml. Every command has a --help with an example.",
)
@click.version_option(__version__, prog_name="ohmskin")
def ohmskin() -> None:
    """Readout, emulation, driver and verification of resistive robot skins."""
    signals.raise_from_now_on()


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    signals.leave_at_once()
    _streams.set_up()
    _set_up_log()
    code = run(args)
    signals.leave_from_now_on(code)
    sys.exit(code)


def _set_up_log() -> None:
    """Show on standard error what the package logs, such as why it waits: for whoever watches, and nobody else."""
    log = logging.getLogger("ohmskin")
    log.setLevel(logging.INFO)
    log.propagate = False  # a package that sets up the root logger would show each message once more
    log.handlers = [logging.StreamHandler() if sys.stderr.isatty() else logging.NullHandler()]


def run(args: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code; every error becomes one line."""
    arguments = sys.argv[1:] if args is None else list(args)
    if _COMPLETE in os.environ:
        return shell_complete(ohmskin, {}, "ohmskin", _COMPLETE, os.environ[_COMPLETE])
    state: dict[str, bool] = {}
    try:
        return _invoke(arguments, state)
    except click.exceptions.Exit as error:
        return error.exit_code
    except (KeyboardInterrupt, click.Abort) as error:
        number = signals.number_of(error)
        return _failed(ENDING_SIGNALS.get(number, "interrupted"), 128 + number, state)
    except click.ClickException as error:
        words = (shortened(word, LONGEST_WORD) for word in error.format_message().split())
        return _failed(" ".join(words), BAD_INPUT, state)
    except OhmskinError as error:
        return _failed(str(error), BAD_INPUT, state)
    except _streams.OutputError as error:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  # so that its flush at exit does not fail again
        if error.errno == errno.EPIPE:
            return BROKEN_PIPE
        return _failed(f"standard output: {error.strerror or error}", BAD_INPUT, state)
    except (Exception, SystemExit) as error:  # whatever asks to exit has no verdict
        return _failed(_defect(error), DEFECT, state)


def _invoke(arguments: list[str], state: dict[str, bool]) -> int:
    """Parse and run. Not by ``ohmskin.main``, which has handlers of its own for interrupts and for broken pipes."""
    try:
        with ohmskin.make_context("ohmskin", arguments, obj=state) as context:
            result: Any = ohmskin.invoke(context)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return BAD_INPUT
    return result if isinstance(result, int) else 0


def _failed(message: str, code: int, state: dict[str, bool]) -> int:
    if state.get("debug"):
        traceback.print_exc()
    click.echo(f"ohmskin: {one_line(message)}", err=True)
    return code


def _defect(error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return "out of memory"
    return f"a defect of ohmskin, {type(error).__name__}: {error} (--debug shows where)"
