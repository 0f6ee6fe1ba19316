"""``ohmskin replay``: a recording as a port that any program can open."""

from __future__ import annotations

import time
from pathlib import Path

import click

from ..driver import ReplayPort
from ..emulator import PtyPort, Stop, stop_on_signals
from ..errors import LinkEnded, LinkError
from . import arguments
from ._bar import progress_bar

POLL_S = 0.01
LISTENER_S = 1.0
"""a host that asks nothing for so long is one that only listens"""


@click.command(epilog=arguments.example("ohmskin replay press.mcap --link /tmp/skin --speed 0.5"))
@click.argument("recording", metavar="FILE.mcap", type=click.Path(path_type=Path))
@click.option("--link", type=click.Path(path_type=Path), metavar="PATH", help="Symbolic link to make to the pty.")
@click.option("--speed", type=arguments.positive, default=1.0, show_default=True, help="Times real time.")
def command(recording: Path, link: Path | None, speed: float) -> int:
    """Play FILE.mcap on a pseudo-terminal; the port to open is printed first.

    The bytes come as they came when they were recorded, from the moment at which a host opens the port. A host that
    reads too slowly makes the recording wait. `Skin.open("FILE.mcap")` plays a recording without a port. A driver on
    this machine takes the end of the recording for a regular end.
    """
    with progress_bar("reading") as tell:
        played = ReplayPort(recording, speed, tell)
    with stop_on_signals() as stop, PtyPort(link, listed=False) as port:
        click.echo(port.name)
        _wait_for_host(port, stop)
        while not stop.is_set():
            try:
                if played.wait(0.1):
                    _send(port, played.read().data, stop)
            except LinkEnded:
                break
            except LinkError:
                continue  # the port was gone for a while then; the host's is not
        _drain(port, stop)
        if not stop.is_set():
            port.end()
        return 0 if stop.signal is None else 128 + stop.signal


def _wait_for_host(port: PtyPort, stop: Stop) -> None:
    """Wait until a host has opened the port and, since serial programs discard what came before, is ready to read."""
    while not (port.host_present() or stop.is_set()):
        time.sleep(POLL_S)
    ready_at = time.monotonic() + LISTENER_S
    while time.monotonic() < ready_at and not (stop.is_set() or port.read()):
        time.sleep(POLL_S)


def _drain(port: PtyPort, stop: Stop) -> None:
    """Let the host read to the end."""
    quiet = 0
    # The kernel moves bytes on in steps: empty for a moment is not empty yet.
    while quiet < 3 and port.host_present() and not stop.is_set():
        quiet = 0 if port.unread() else quiet + 1
        time.sleep(POLL_S)


def _send(port: PtyPort, data: bytes, stop: Stop) -> None:
    port.read()  # what a host asks, a recording has no answer to
    while data and not stop.is_set():
        sent = port.write(data) if port.host_present() else 0
        data = data[sent:]
        if not sent:
            time.sleep(0.002)
