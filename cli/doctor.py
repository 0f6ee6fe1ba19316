"""``ohmskin doctor``: what is installed, which ports are there, and what to type to mend what is not right."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import click

from ..common.files import check_writable
from ..common.json_text import json_text
from ..common.tables import write_text
from ..common.text import one_line
from ..doctor import (
    START_WORDS,
    Finding,
    State,
    Traffic,
    examine_device,
    examine_installation,
    examine_ports,
    examine_traffic,
    has_baud_rate,
)
from ..errors import InputError, LinkError
from . import arguments

USUAL_FILE = "board.toml"


@click.command(
    epilog=arguments.example(
        "ohmskin doctor", "ohmskin doctor /dev/ttyUSB0", "ohmskin doctor /dev/ttyUSB0 --baud 76800 -o mat.toml"
    )
)
@click.argument("port", required=False)
@click.option("--baud", type=click.IntRange(min=1), metavar="N", help="The only baud rate to try [all common ones].")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="BOARD.toml",
    help=f"Where to draft the description of a board of no known family [{USUAL_FILE}, or board-2.toml ...].",
)
@click.option("--draft", "described", is_flag=True, help="Draft, even if the board sounds like a known family.")
@click.option("--overwrite", is_flag=True, help="Replace BOARD.toml if it is there already.")
@click.option("--poke", is_flag=True, help="Send a silent board what many boards wait for, without asking first.")
@arguments.as_json("the findings")
def command(
    port: str | None,
    baud: int | None,
    output: Path | None,
    described: bool,
    overwrite: bool,
    poke: bool,
    as_json: bool,
) -> int:
    """Look at this installation and its serial ports, or at PORT alone, and say what to type to mend each problem.

    The board at PORT is listened to, and asked if it is silent. If no known family sends what it sends, its format is
    worked out and written to BOARD.toml, for the option --board of other commands.

    Exit code 0: no problem; 3: a problem. A missing optional part is no problem.
    """
    if port is None:
        for name, given in (("--baud", baud), ("--output", output)):
            if given is not None:
                raise InputError(f"{name} needs a PORT")
        findings = [*examine_installation(), *examine_ports()]
    else:
        findings = _examine_port(port, baud, _place(output, overwrite=overwrite), described=described, poke=poke)
    if as_json:
        click.echo(json_text([asdict(finding) for finding in findings], indent=1))
    else:
        for finding in findings:
            _show(finding)
    return 3 if any(finding.state is State.PROBLEM for finding in findings) else 0


def _place(output: Path | None, *, overwrite: bool) -> Path:
    """Where a draft goes; InputError if it cannot go there."""
    if output is None:
        names = [USUAL_FILE, *(f"board-{number}.toml" for number in range(2, 100))]
        return next(path for name in names if overwrite or not (path := Path(name)).exists() or name == names[-1])
    if output.exists() and not overwrite:
        raise InputError(f"{output}: is there already; choose another name, or replace it (--overwrite)")
    if output.suffix != ".toml":
        raise InputError(f"{output}: is no name of a description; expected FILE.toml")
    check_writable(output)
    return output


def _examine_port(port: str, baud: int | None, output: Path, *, described: bool, poke: bool) -> list[Finding]:
    """The device first; its traffic only where the device can be opened."""
    findings = [] if "://" in port else examine_device(port)
    try:
        with _progress() as tell:
            traffic = examine_traffic(
                port, baud=baud, described=described, poke=lambda: poke or _may_poke(port), tell=tell
            )
    except LinkError as error:
        if any(finding.state is State.PROBLEM for finding in findings):
            return findings  # which say why it cannot be opened
        return [*findings, Finding(State.PROBLEM, port, str(error).removeprefix(f"{port}: "))]
    return [*findings, *_drafted(port, traffic, output)]


def understood(port: str, baud: int | None) -> str | None:
    """Find out what sends the bytes at a port, and show it.

    Returns:
        The board: the name of its family, or the file that describes it; None: it is not understood.

    """
    output = _place(None, overwrite=False)
    with _progress() as tell:
        traffic = examine_traffic(port, baud=baud, poke=lambda: _may_poke(port), tell=tell)
    for finding in _drafted(port, traffic, output):
        _show(finding, err=True)
    return traffic.family or (None if traffic.draft is None else str(output))


def _drafted(port: str, traffic: Traffic, output: Path) -> list[Finding]:
    """The finding, and the file that was written for it."""
    draft = traffic.draft
    if draft is None:
        return [traffic.finding]
    view = f"ohmskin view {port} --board {output}"
    rate = f" at {traffic.baud_rate} baud" if has_baud_rate(port) else ""
    head = [
        f"Drafted by `ohmskin doctor {one_line(port)}`, which heard {draft.summary}{rate}.",
        "docs/boards.md explains every key. Look at the lines with a question mark, then:",
        "",
        f"    {one_line(view)}",
        "",
        "The page shows counts. For ohms and kPa, name the circuit and the material in [board]:",
        'design = "design.toml" (docs/design-file.md) and cell = "cell.toml" (docs/cell.md).',
    ]
    write_text(output, draft.toml(head))
    others = [
        Finding(State.OPTIONAL, str(output), f"another layout would be {text}: {100 * share:.0f} % of the bytes")
        for text, share in draft.others
    ]
    questions = [Finding(State.OPTIONAL, str(output), question) for question in draft.questions]
    return [replace(traffic.finding, mend=view), Finding(State.OK, str(output), "written"), *questions, *others]


def _may_poke(port: str) -> bool:
    """Whether the person at the terminal lets us send words that start boards; without one it is no."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    words = ", ".join(repr(word.decode()) for word in START_WORDS)
    click.echo(f"\r\x1b[K{one_line(port)} is silent. Many boards wait for a word: {words}.", err=True)
    return click.confirm("Send these, one after the other?", err=True)


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """A line on standard error that says what is being done, where somebody watches."""
    watched = sys.stderr.isatty()

    def tell(text: str) -> None:
        if watched:
            click.echo(f"\r\x1b[K{one_line(text)} ...", err=True, nl=False)

    try:
        yield tell
    finally:
        if watched:
            click.echo("\r\x1b[K", err=True, nl=False)


def _show(finding: Finding, *, err: bool = False) -> None:
    click.echo(f"{finding.state:<9} {one_line(finding.subject)}: {one_line(finding.found)}", err=err)
    if finding.mend:
        click.echo(f"{'':9}   -> {one_line(finding.mend)}", err=err)
