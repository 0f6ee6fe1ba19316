"""A firmware board in service on a pty or TCP port: the loop around processor, serial converter, port and clock.

``real``
    Board time is the machine's. When the machine cannot keep up, board time falls behind.
``fast``
    Board time passes as fast as the host reads, and stands still while no host is there. It begins with the first byte
    of a host, or one second after a silent one has come: serial programs discard what came before they were ready.

Between board and port there is a USB converter with a small buffer and a handshake line: while the buffer is full the
board may not send, and drops whole frames.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from math import inf
from pathlib import Path

from ...common.checks import positive
from .._faults import Line, Schedule, may_lose
from .._hand import Hand
from .._ports import Port
from .._scene import Scene
from .._service import (
    HOST_POLL_S,
    LISTENER_S,
    MOST_BEHIND_S,
    ClockName,
    HasFileno,
    Outcome,
    Stop,
    in_thread,
    tell_over,
    wait_for,
)
from .._truth import TruthFile
from ._board import BoardSettings, FirmwareBoard
from ._engines import AVR8JS, Engine

SLICE_S = 5e-3
"""s of board time between two looks at the port"""
CONVERTER_BYTES = 4096
"""in the buffer of the USB converter when it stops the board; what is on its way then still fits"""


def emulate_firmware(
    scene: Scene,
    port: Port,
    *,
    clock: ClockName = "real",
    duration_s: float = inf,
    seed: int = 0,
    truth: Path | None = None,
    settings: BoardSettings | None = None,
    engine: Engine = AVR8JS,
    hand: Hand | None = None,
    ready: Callable[[], None] = lambda: None,
    stop: Stop,
) -> Outcome:
    """Run a firmware board on ``port`` for ``duration_s`` of board time or until ``stop``; then write the truth file.

    Args:
        scene: skin, circuit and contacts; its array is that of one of the boards.
        port: where a host may come.
        clock: see above.
        duration_s: of board time.
        seed: for noise and line faults.
        truth: .npz file of the frames that left the board, as they truly were.
        settings: of the board; None: frame rate and serial number of the scene.
        engine: emulator of the processor.
        hand: presses beside the scene's contacts.
        ready: called when the board is there, and nothing of what was asked for is refused any more.
        stop: ends the run.

    Raises:
        InputError: the duration is not above 0, no firmware fits the scene, or the truth file cannot be written.
        MissingExtra: the engine cannot run here.
        LinkError: the port or the emulated processor failed.

    """
    duration_s = positive("duration", duration_s, "s")
    outcome = Outcome()
    with nullcontext() if truth is None else TruthFile(truth, scene.skin.design.array.shape) as file:
        record = None if file is None else file.append
        boot_id = secrets.randbits(32)
        with FirmwareBoard(
            scene, settings=settings, engine=engine, seed=seed, boot_id=boot_id, hand=hand, record=record
        ) as board:
            converter = _Converter(board, port, seed)
            ready()
            start = time.monotonic()
            while board.time_s < duration_s and not stop.is_set():
                converter.exchange()
                if clock == "fast":
                    wait_s = 0.0 if converter.hungry else HOST_POLL_S
                else:
                    wait_s = start + board.time_s - time.monotonic()
                    if wait_s < -MOST_BEHIND_S:
                        start -= wait_s
                        outcome.behind_s -= wait_s
                if wait_s <= 0:
                    converter.run(min(SLICE_S, duration_s - board.time_s))
                else:
                    converter.wait(stop, wait_s)
            outcome.seconds = min(board.time_s, duration_s)
            converter.drain(stop)
            if not stop.is_set():
                port.end()
    return outcome


@contextmanager
def running_firmware(
    scene: Scene,
    port: Port,
    *,
    clock: ClockName = "real",
    duration_s: float = inf,
    seed: int = 0,
    truth: Path | None = None,
    settings: BoardSettings | None = None,
    engine: Engine = AVR8JS,
    hand: Hand | None = None,
) -> Iterator[None]:
    """:func:`emulate_firmware` in a thread while the block lasts; the port is closed at its end.

    Raises:
        InputError, MissingExtra: before the block begins, as :func:`emulate_firmware`.

    """
    engine.require()
    with in_thread(
        lambda stop: emulate_firmware(
            scene,
            port,
            clock=clock,
            duration_s=duration_s,
            seed=seed,
            truth=truth,
            settings=settings,
            engine=engine,
            hand=hand,
            stop=stop,
        ),
        port,
    ):
        yield


class _Converter:
    """The USB converter: bytes of the board on one side, the port on the other."""

    def __init__(self, board: FirmwareBoard, port: Port, seed: int) -> None:
        self._board, self._port = board, port
        self._line = Line(board.scene.line, seed, board.scene.link_fault)
        self._schedule = Schedule(board.scene.link_fault)
        self._present = False
        self._over = False
        """no time passes any more, so a stall would not end"""
        self._ready_at = 0.0
        """monotonic time from which on the host is taken to listen"""
        self._buffer = bytearray()
        self._packet = b""
        """the beginning of a packet whose end has not left the board"""

    @property
    def hungry(self) -> bool:
        """Whether a host is there, is ready, and has taken nearly all that was sent, unless the line is stalled."""
        ready = self._present and time.monotonic() >= self._ready_at
        # A stall ends when board time has passed, whatever waits meanwhile.
        return ready and (self._stalled or len(self._buffer) < CONVERTER_BYTES // 2)

    @property
    def _stalled(self) -> bool:
        return not self._over and self._schedule.active("stall", self._board.time_s) is not None

    def exchange(self) -> None:
        """Bytes from the port to the board, and from the buffer to the port."""
        was_present, self._present = self._present, self._port.host_present()
        if self._present != was_present:
            self._buffer.clear()
        if self._present and not was_present:
            self._buffer += b"\0"  # ends what may have been cut off for the last host
            self._ready_at = time.monotonic() + LISTENER_S
        if self._present:
            data = self._port.read()
            if data is None:
                self._present = False
                self._buffer.clear()
            elif data:
                self._board.send(data)
                self._ready_at = 0.0
        if self._present and self._buffer and not self._stalled:
            del self._buffer[: self._port.write(bytes(self._buffer))]
        self._board.clear_to_send = len(self._buffer) < CONVERTER_BYTES

    def run(self, seconds: float) -> None:
        """Let the board live; the faults of the scene's line befall whole packets."""
        *packets, self._packet = (self._packet + self._board.run(seconds)).split(b"\0")
        if self._present:
            for packet in packets:
                self._buffer += self._line.carry(packet + b"\0", self._board.time_s)

    def wait(self, stop: Stop, timeout_s: float) -> None:
        """Until the port or ``stop`` wants attention, or ``timeout_s`` has passed."""
        readable: list[HasFileno] = [stop, self._port] if self._present else [stop]
        writable: list[HasFileno] = [self._port] if self._present and self._buffer else []
        wait_for(readable, writable, min(timeout_s, HOST_POLL_S))

    def drain(self, stop: Stop) -> None:
        """Let a host take what was sent, and the end; unless the board was switched off, and may come back."""
        self.exchange()
        if stop.is_set():
            return
        self._over = True
        scene = self._board.scene
        tell_over(self, stop, lossy=may_lose(scene.line, scene.link_fault))

    @property
    def present(self) -> bool:
        return self._present

    def say_over(self) -> bool:
        farewell = self._board.farewell()
        if self._present and farewell:
            self._buffer += self._line.carry(farewell, self._board.time_s)
        return True

    def unsent(self) -> int:
        return len(self._buffer)

    def unread(self) -> int:
        return self._port.unread()

    def rest(self, stop: Stop) -> None:
        self.wait(stop, HOST_POLL_S)
