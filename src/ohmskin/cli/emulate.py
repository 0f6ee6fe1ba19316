"""``ohmskin emulate``: a virtual scan board on a pty or TCP port."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import cast

import click

from ..emulator import ClockName, PtyPort, Scene, TcpPort, emulate, stop_on_signals
from . import arguments


@click.command(epilog=arguments.example("ohmskin emulate scene.toml --link /tmp/skin --truth truth.npz"))
@click.argument("scene_file", metavar="SCENE.toml", type=click.Path(path_type=Path))
@click.option("--link", type=click.Path(path_type=Path), metavar="PATH", help="Symbolic link to make to the pty.")
@click.option("--tcp", metavar="HOST:PORT", help="Listen here instead of on a pty; :PORT is the loopback.")
@click.option("--clock", type=click.Choice(["real", "fast"]), default="real", show_default=True)
@click.option(
    "--duration", type=click.FloatRange(min=0, min_open=True), default=inf, metavar="S", help="Seconds of board time."
)
@click.option(
    "--truth", type=click.Path(path_type=Path), metavar="FILE.npz", help="Record every frame as it truly was."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, metavar="K", help="For noise and line faults.")
def command(
    scene_file: Path, link: Path | None, tcp: str | None, clock: str, duration: float, truth: Path | None, seed: int
) -> int:
    """Emulate the board and skin of SCENE.toml; the port to open is printed first.

    With --clock real the board runs whether anyone reads or not. With --clock fast it runs as fast as it is read.
    """
    if link is not None and tcp is not None:
        raise click.UsageError("--link and --tcp exclude each other")
    scene = Scene.load(scene_file)
    with stop_on_signals() as stop, PtyPort(link) if tcp is None else TcpPort.at(tcp) as port:
        click.echo(port.name)
        outcome = emulate(
            scene,
            port,
            clock=cast("ClockName", clock),
            duration_s=duration,
            seed=seed,
            truth=truth,
            stop=stop,
        )
        for note in outcome.notes():
            click.echo(f"ohmskin: {note}", err=True)
        return 0 if stop.signal is None else 128 + stop.signal
