"""``ohmskin emulate``: a virtual scan board on a pseudo-terminal, a TCP port or an RFC 2217 port."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from math import inf
from pathlib import Path
from typing import cast

import click

from ..common.files import of_board
from ..emulator import (
    ClockName,
    EngineName,
    Options,
    Port,
    PtyPort,
    Rfc2217Port,
    Scene,
    TcpPort,
    emulate,
    load_scenes,
    plan,
    running,
    stop_on_signals,
)
from ..emulator.firmware import AVR8JS, check_scene
from ..wire import board_family
from . import arguments
from ._skin_options import BOARD_HELP


@click.command(epilog=arguments.example("ohmskin emulate scene.toml --link /tmp/skin --truth truth.npz"))
@click.argument("scene_file", metavar="SCENE.toml", type=click.Path(path_type=Path))
@click.option("--board", "family", default="ohmskin", show_default=True, metavar="NAME|FILE.toml", help=BOARD_HELP)
@click.option(
    "--baud", type=click.IntRange(min=300), metavar="N", help="Baud rate of the board's UART [the scene's, else none]."
)
@click.option("--link", type=click.Path(path_type=Path), metavar="PATH", help="Symbolic link to make to the pty.")
@click.option("--tcp", metavar="HOST:PORT", help="Listen here instead of on a pty; :PORT is the loopback.")
@click.option("--rfc2217", metavar="HOST:PORT", help="Likewise, with baud rate and control lines (Telnet).")
@click.option("--clock", type=click.Choice(["real", "fast"]), default="real", show_default=True)
@click.option(
    "--engine",
    type=click.Choice(["model", "firmware"]),
    default="model",
    show_default=True,
    help="What runs the board: a model of it, or the reference board's program on an emulated processor (Node.js).",
)
@click.option("--duration", type=arguments.positive, default=inf, metavar="S", help="Seconds of board time.")
@click.option(
    "--truth", type=click.Path(path_type=Path), metavar="FILE.npz", help="Record every frame as it truly was."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, metavar="K", help="For noise and line faults.")
@click.option("--plan", "only_plan", is_flag=True, help="Only print what would be modelled, what not, and the cost.")
def command(
    scene_file: Path,
    family: str,
    baud: int | None,
    link: Path | None,
    tcp: str | None,
    rfc2217: str | None,
    clock: str,
    engine: str,
    duration: float,
    truth: Path | None,
    seed: int,
    only_plan: bool,
) -> int:
    """Emulate the board and skin of SCENE.toml; the port to open is printed first. A scene may have several boards.

    With --clock real the board runs whether anyone reads or not. With --clock fast it runs as fast as it is read.
    """
    if sum(place is not None for place in (link, tcp, rfc2217)) > 1:
        raise click.UsageError("--link, --tcp and --rfc2217 exclude each other")
    board_family(family)
    scenes = load_scenes(scene_file)
    if len(scenes) > 1 and (tcp is not None or rfc2217 is not None or clock == "fast"):
        raise click.UsageError(
            "several boards have ptys, and the real clock; expected no --tcp, --rfc2217, --clock fast"
        )
    if baud is not None:
        scenes = tuple(scene.replace(line={"baud_rate": baud}) for scene in scenes)
    if only_plan:
        click.echo("\n\n".join("\n".join(plan(scene, seed=seed).lines()) for scene in scenes))
        return 0
    if engine == "firmware":
        if family != "ohmskin":
            raise click.UsageError(f"--engine firmware and --board {family} exclude each other")
        for scene in scenes:
            check_scene(scene)
        AVR8JS.require()
    options: Options = {
        "clock": cast("ClockName", clock),
        "duration_s": duration,
        "seed": seed,
        "family": family,
        "engine": cast("EngineName", engine),
    }
    banners = []
    with ExitStack() as boards:
        for k, scene in enumerate(scenes[1:], start=1):
            port = PtyPort(None if link is None else of_board(link, k))
            own = options | {"seed": seed + k, "truth": None if truth is None else of_board(truth, k)}
            boards.enter_context(running(scene, port, **own))
            banners.append(banner(scene, port, family))
        if banners:
            link, truth = (None if name is None else of_board(name, 0) for name in (link, truth))
        return _emulate(scenes[0], link, tcp, rfc2217, options | {"truth": truth}, banners)


def _emulate(
    scene: Scene, link: Path | None, tcp: str | None, rfc2217: str | None, options: Options, others: list[str]
) -> int:
    """Run a board until its time is over or a signal comes; returns the exit code. ``others``: banners of boards."""
    with stop_on_signals() as stop, _port(link, tcp, rfc2217) as port:
        family = str(options["family"])
        banners = "\n".join([banner(scene, port, family), *others])
        announce = partial(click.echo, banners)  # who reads the name of the port may open it
        outcome = emulate(scene, port, ready=announce, stop=stop, **options)
        for note in outcome.notes():
            click.echo(f"ohmskin: {note}", err=True)
        return 0 if stop.signal is None else 128 + stop.signal


def _port(link: Path | None, tcp: str | None, rfc2217: str | None) -> Port:
    if tcp is not None:
        return TcpPort.at(tcp)
    if rfc2217 is not None:
        return Rfc2217Port.at(rfc2217)
    return PtyPort(link)


def banner(scene: Scene, port: Port, family: str) -> str:
    """The name of the port, alone on its line for scripts, and how to connect, for people."""
    design = scene.skin.design
    assert design.adc is not None  # a scene is refused without one
    rows, columns = design.array.shape
    board = "" if family == "ohmskin" else f', board="{family}"'
    baud_rate = scene.line.baud_rate or board_family(family).baud_rate
    return "\n".join(
        [
            port.name,
            f"  board     {family}, {rows} x {columns} cells of {design.adc.bits} bits, "
            f"{scene.board.frame_rate:g} frames/s, serial number {scene.board.serial_number}",
            f'  driver    Skin.open("{port.name}"{board})',
            f'  pyserial  serial.serial_for_url("{port.name}", {baud_rate})',
        ]
    )
