"""The loop that lets a board live: clock, port and stop signal around the pure core.

``real``
    Time is the machine's. Ticks come when they are due, whether a host reads or not; what the transmit buffer
    cannot take is lost, as on a serial line. When the machine cannot keep up, board time falls behind.
``fast``
    Time is as fast as the host takes the bytes. It stands still while no host is there, before START, while
    stopped, and while the buffer is full, so nothing is lost. A host that says nothing for a second after
    opening the port is one that only listens: the board then starts by itself.
"""

from __future__ import annotations

import os
import secrets
import select
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Literal

from ..errors import InputError
from ..wire import BoardProtocol, board_protocol
from ._board import Board
from ._line import Line, TransmitBuffer
from ._ports import Port
from ._scene import Scene
from ._truth import TruthFile

ClockName = Literal["real", "fast"]

HOST_POLL_S = 0.01
"""how often to look whether a host has come: opening a pty wakes nobody"""
LONGEST_WAIT_S = 0.1
"""how often to look in any case: for a second host to turn away"""
LISTENER_S = 1.0
"""fast clock: how long a host may say nothing before it is taken for a mere listener"""
MOST_BEHIND_S = 0.5
"""real clock: how late a tick may be before board time is let go"""
ANSWER_ROOM = 4096
"""bytes in the transmit buffer up to which commands are answered; beyond, their answers wait"""
DRAIN_S = 5.0
"""at the end: how long to wait for a host that has stopped reading"""


class Stop:
    """A request to end the run, from a signal or another thread; the loop waits for it along with the port."""

    def __init__(self) -> None:
        self.signal: int | None = None
        """the signal that asked, if one did"""
        self._read, self._write = os.pipe()

    def set(self, number: int | None = None) -> None:
        """End the run between two ticks."""
        self.signal = self.signal or number
        os.write(self._write, b"!")

    def is_set(self) -> bool:
        return bool(select.select([self._read], [], [], 0)[0])

    def fileno(self) -> int:
        return self._read

    def close(self) -> None:
        os.close(self._read)
        os.close(self._write)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """A :class:`Stop` that SIGINT and SIGTERM set, instead of what they did before. In the main thread only."""
    stop = Stop()
    before = {
        number: signal.signal(number, lambda number, _: stop.set(number)) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        stop.close()


@dataclass
class Outcome:
    """What a run came to."""

    seconds: float = 0.0
    """board time"""
    dropped: int = 0
    """frames that a host was too slow for"""
    behind_s: float = 0.0
    """real clock: by how much board time fell behind because this machine was too slow"""

    def notes(self) -> list[str]:
        """What whoever started the run should know, a line each."""
        notes = []
        if self.dropped:
            notes.append(f"{self.dropped} frames were dropped: the host read too slowly")
        if self.behind_s:
            notes.append(f"board time fell {self.behind_s:.1f} s behind: this machine is too slow for the scene")
        return notes


def emulate(
    scene: Scene,
    port: Port,
    *,
    clock: ClockName = "real",
    duration_s: float = inf,
    seed: int = 0,
    truth: Path | None = None,
    family: str = "ohmskin",
    stop: Stop,
) -> Outcome:
    """Run a board on ``port`` for ``duration_s`` of board time or until ``stop``, and write the truth file then.

    Raises:
        InputError: the duration is not positive, or the truth file cannot be written.
        LinkError: the port failed.
        SolverError: the scene leads to a circuit without a solution.

    """
    if not duration_s > 0:
        raise InputError(f"duration is {duration_s} s; expected more than 0")
    with nullcontext() if truth is None else TruthFile(truth, scene.skin.design.array.shape) as file:
        board = Board(
            scene,
            seed=seed,
            boot_id=secrets.randbits(32),
            duration_s=duration_s,
            protocol=_protocol(family, scene),
            record=None if file is None else file.append,
        )
        outcome = Outcome()
        pace: _Clock = _RealClock(outcome) if clock == "real" else _FastClock()
        link = _Link(board, port, Line(scene.line, seed), pace.buffer(scene), outcome)
        while board.next_us < duration_s * 1e6 and not stop.is_set():
            if link.exchange():
                pace.host_arrived(board)
            if pace.due(board, link):
                link.send(board.tick())
            else:
                link.wait(stop, pace.wait_s(board))
        outcome.seconds = min(board.next_us / 1e6, duration_s)
        link.drain(stop)
    return outcome


@contextmanager
def running(
    scene: Scene,
    port: Port,
    *,
    clock: ClockName = "real",
    duration_s: float = inf,
    seed: int = 0,
    truth: Path | None = None,
    family: str = "ohmskin",
) -> Iterator[None]:
    """:func:`emulate` in a thread while the block lasts: a board for a test in the same process.

    The port is closed when the board's time is over or the block ends. What :func:`emulate` raises is raised at the
    end of the block.
    """
    stop, failures = Stop(), []

    def live() -> None:
        try:
            with port:
                emulate(
                    scene, port, clock=clock, duration_s=duration_s, seed=seed, truth=truth, family=family, stop=stop
                )
        except Exception as error:
            failures.append(error)

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        stop.close()
    if failures:
        raise failures[0]


def _protocol(family: str, scene: Scene) -> BoardProtocol:
    design = scene.skin.design
    assert design.adc is not None  # a scene is refused without one
    return board_protocol(family, shape=design.array.shape, adc_bits=design.adc.bits)


class _Link:
    """Board, line and buffer on one side, the port on the other."""

    def __init__(self, board: Board, port: Port, line: Line, buffer: TransmitBuffer, outcome: Outcome) -> None:
        self.present = False
        self.buffer = buffer
        self._board, self._port, self._line, self._outcome = board, port, line, outcome

    def exchange(self) -> bool:
        """Read commands, write what waits; True when a host has just come."""
        was_present, self.present = self.present, self._port.host_present()
        arrived = self.present and not was_present
        if self.present != was_present:
            self.buffer.clear()
        if arrived:
            self.buffer.offer(b"\0")  # ends what may have been cut off for the last host
        if self.present:
            data = self._port.read()
            if data is None:
                self.present = False
                self.buffer.clear()
                return False
            self._board.receive(data)
            if len(self.buffer) < ANSWER_ROOM:
                for answer in self._board.answers():
                    self.buffer.offer(self._line.carry(answer))
            if self.buffer:
                self.buffer.sent(self._port.write(self.buffer.peek()))
        return arrived

    def send(self, packets: list[bytes]) -> None:
        """Send the packets of one tick, all or none. Without a host they are spoken to the wind."""
        delivered = b"".join(map(self._line.carry, packets))
        frames = self._board.streaming
        if self.present and not self.buffer.offer(delivered) and frames:
            self._board.overrun = True
            self._outcome.dropped += 1

    def wait(self, stop: Stop, timeout_s: float) -> None:
        """Until the port or ``stop`` wants attention, or ``timeout_s`` has passed, or something else may be new."""
        readable: list[Stop | Port] = [stop, self._port] if self.present else [stop]
        writable = [self._port] if self.present and self.buffer else []
        longest = LONGEST_WAIT_S if self.present else HOST_POLL_S
        select.select(readable, writable, [], min(max(timeout_s, 0.0), longest))

    def drain(self, stop: Stop) -> None:
        """Let a host read to the end what was written, as long as it goes on reading."""
        left, patience_ends, quiet = None, 0.0, 0
        while not stop.is_set() and quiet < 3:
            self.exchange()
            if not self.present:
                return
            before, left = left, (len(self.buffer), self._port.unread())
            now = time.monotonic()
            if left != before:
                patience_ends = now + DRAIN_S
            elif now > patience_ends:
                return
            # The kernel moves bytes on in steps: empty for a moment is not empty yet.
            quiet = quiet + 1 if left == (0, 0) else 0
            select.select([stop], [], [], HOST_POLL_S)


class _Clock(ABC):
    """When to tick."""

    @abstractmethod
    def buffer(self, scene: Scene) -> TransmitBuffer:
        """A transmit buffer that loses what this clock means to lose."""

    @abstractmethod
    def host_arrived(self, board: Board) -> None:
        """A host has opened the port."""

    @abstractmethod
    def due(self, board: Board, link: _Link) -> bool:
        """Whether the next tick is due now."""

    @abstractmethod
    def wait_s(self, board: Board) -> float:
        """How long nothing can become due by itself."""


class _RealClock(_Clock):
    def __init__(self, outcome: Outcome) -> None:
        self._outcome = outcome
        self._start = time.monotonic()

    def buffer(self, scene: Scene) -> TransmitBuffer:
        # A description and a few frames, as a microcontroller would have.
        rows, columns = scene.skin.design.array.shape
        return TransmitBuffer(8192 + 8 * rows * columns)

    def host_arrived(self, board: Board) -> None:
        pass

    def due(self, board: Board, link: _Link) -> bool:
        late = -self.wait_s(board)
        if late > MOST_BEHIND_S:
            self._start += late
            self._outcome.behind_s += late
        return late >= 0

    def wait_s(self, board: Board) -> float:
        return self._start + board.next_us / 1e6 - time.monotonic()


class _FastClock(_Clock):
    _ENOUGH = 4096

    def __init__(self) -> None:
        self._orders = 0
        self._silent_until = inf

    def buffer(self, scene: Scene) -> TransmitBuffer:
        # No limit of its own: no tick is due while more than a little waits.
        return TransmitBuffer(2**62)

    def host_arrived(self, board: Board) -> None:
        # Serial programs discard what came before they were ready: say nothing until they are.
        board.streaming = False
        self._orders = board.orders
        self._silent_until = time.monotonic() + LISTENER_S

    def due(self, board: Board, link: _Link) -> bool:
        if not link.present:
            return False
        if board.orders == self._orders and time.monotonic() >= self._silent_until:
            board.streaming = not board.protocol.family.polled
        return board.wants_tick and len(link.buffer) < self._ENOUGH

    def wait_s(self, board: Board) -> float:
        return HOST_POLL_S
