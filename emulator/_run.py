"""The loop that lets a board live: clock, port and stop signal around the pure core.

``real``
    Time is the machine's. Ticks come when they are due, whether a host reads or not; what the transmit buffer
    cannot take is lost, as on a serial line. When the machine cannot keep up, board time falls behind.
``fast``
    Time is as fast as the host takes the bytes. It stands still while no host is there, before START, while
    stopped, and while the buffer is full, so nothing is lost. A host that has said nothing for a second and has
    given no such command yet is one that only listens: the board then starts by itself.
"""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from math import inf, nan
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

from ..common.checks import positive
from ..wire import BoardProtocol, Family, board_protocol
from ._board import Board
from ._device import Device, LivingBoard
from ._hand import Hand
from ._ports import Port
from ._scene import Scene
from ._service import ClockName, HasFileno, Outcome, Stop, in_thread, wait_for
from ._truth import TruthFile
from ._tuning import DRAIN_S, HOST_POLL_S, LISTENER_S, LONGEST_WAIT_S, MOST_BEHIND_S, PIECE, SOON_S, TICKS_AT_ONCE
from .firmware import AVR8JS, FirmwareInService, check_scene

EngineName = Literal["model", "firmware"]


class Options(TypedDict, total=False):
    """How to run a board, with the usual values: keyword arguments of :func:`emulate` and :func:`running`."""

    clock: ClockName
    """``real`` (usual) or ``fast``, see the head of this module"""
    duration_s: float
    """s of board time; usually without end"""
    seed: int
    """for noise, faults and jitter; usually 0"""
    truth: Path | None
    """file for every frame as it truly was; None: none"""
    family: str | Path | Family
    """whose protocol the board speaks, as for :func:`ohmskin.wire.board_family`; usually the native one"""
    engine: EngineName
    """``model`` (usual), or ``firmware`` for the reference board's own program, which speaks the native protocol"""
    hand: Hand | None
    """presses beside the scene's contacts"""


def emulate(
    scene: Scene, port: Port, *, stop: Stop, ready: Callable[[], None] = lambda: None, **options: Unpack[Options]
) -> Outcome:
    """Run a board on ``port`` until its time is over or ``stop``, and write the truth file then.

    Args:
        scene: what to emulate.
        port: where a host meets the board; left open.
        stop: asks for the end.
        ready: called when the board is there, and nothing of what was asked for is refused any more.
        options: see :class:`Options`.

    Raises:
        InputError: the duration is not above 0, the family has no such array, no firmware fits the scene, or the truth
            file cannot be written.
        MissingExtra: the firmware cannot run here.
        LinkError: the port or the emulated processor failed.
        SolverError: the scene leads to a circuit without a solution.

    """
    duration_s = positive("duration", options.get("duration_s", inf), "s")
    clock, truth, seed = options.get("clock", "real"), options.get("truth"), options.get("seed", 0)
    with contextlib.ExitStack() as stack:
        file = None if truth is None else stack.enter_context(_truth_file(truth, scene))
        life: dict[str, Any] = {
            "seed": seed,
            "boot_id": secrets.randbits(32),
            "duration_s": duration_s,
            "hand": options.get("hand"),
            "record": None if file is None else file.append,
        }
        # At the fast clock no tick is due while more than a little waits; only a UART can overflow.
        capacity = 2**62 if clock == "fast" and scene.line.baud_rate is None else None
        board: LivingBoard
        if options.get("engine", "model") == "firmware":
            board = stack.enter_context(FirmwareInService(scene, **life))
            usb = scene.replace(line={"baud_rate": None})  # behind the converter; the board's UART is in the processor
            handshake_bytes = inf if clock == "fast" else PIECE
            device = Device(usb, board, seed=seed, capacity=2**62, handshake_bytes=handshake_bytes)
        else:
            protocol = _protocol(options.get("family", "ohmskin"), scene)
            board = Board(scene, protocol=protocol, ahead=clock == "real", **life)
            device = Device(scene, board, seed=seed, capacity=capacity)
        board.prepare()
        outcome = Outcome()
        pace = (_RealPace if clock == "real" else _FastPace)(device, outcome)
        session = _Session(device, port, pace, auto_reset=scene.line.auto_reset)
        ready()
        end_us = duration_s * 1e6
        while board.next_us < end_us and not stop.is_set():
            session.exchange()
            if not session.live(end_us):
                session.wait(stop)
        outcome.seconds = min(device.time_s, duration_s)
        outcome.hung_up = list(port.hung_up)
        session.drain(stop)
        if not stop.is_set():
            port.end()
        outcome.dropped, outcome.lost_bytes = device.dropped, device.transmission.lost_bytes
    return outcome


def running(scene: Scene, port: Port, **options: Unpack[Options]) -> AbstractContextManager[None]:
    """:func:`emulate` in a thread while the block lasts: a board for a test in the same process.

    The block begins when the board is there, and the port is closed when its time is over or the block ends. What
    :func:`emulate` raises is raised at the end of the block; only a firmware that cannot run here is refused before.
    """
    if options.get("engine") == "firmware":
        check_scene(scene)
        AVR8JS.require()
    return in_thread(lambda stop, ready: emulate(scene, port, stop=stop, ready=ready, **options), port)


def _truth_file(path: Path, scene: Scene) -> TruthFile:
    skin = scene.skin
    pitch_mm = skin.cell_pitch_mm if skin.design.shape is None else nan
    return TruthFile(path, skin.design.array.shape, pitch_mm=pitch_mm, full_scale_kpa=skin.cell.full_scale_kpa)


def _protocol(family: str | Path | Family, scene: Scene) -> BoardProtocol:
    design = scene.skin.design
    assert design.adc is not None  # a scene is refused without one
    return board_protocol(family, shape=design.array.shape, adc_bits=design.adc.bits)


class _Session:
    """The device on one side, the port on the other, and a host who comes and goes."""

    def __init__(self, device: Device, port: Port, pace: _RealPace, *, auto_reset: bool) -> None:
        self._device, self._port, self._pace = device, port, pace
        self._auto_reset = auto_reset
        self._present = False
        self._hosts = port.hosts
        self._plugged = True

    def exchange(self) -> None:
        """Read commands and write what has arrived at the host's end."""
        if not self._follow_cable():
            return
        was_present, self._present = self._present, self._port.host_present()
        now_us = self._pace.now_us()
        another = self._port.hosts != self._hosts
        self._hosts = self._port.hosts
        if self._present != was_present or another:
            self._device.transmission.clear(now_us)
        if self._present and (another or not was_present):
            self._host_arrived(now_us)
        if not self._present:
            return
        data = self._port.read()
        if data is None:
            self._present = False
            self._device.transmission.clear(now_us)
            return
        if data:
            self._pace.host_spoke()
        if self._auto_reset and self._port.take_reset():
            self._device.reset("", now_us)
        self._device.receive(data, now_us)
        self._deliver(now_us)

    def live(self, end_us: float) -> bool:
        """Live through the ticks that are due; whether there was one."""
        for tick in range(TICKS_AT_ONCE):
            if self._device.board.next_us >= end_us or not self._pace.due(host_present=self._present):
                return tick > 0
            self._device.tick(host_present=self._present)
            if len(self._device.transmission.host) >= PIECE:
                break
        return True

    def wait(self, stop: Stop) -> None:
        """Until the port or ``stop`` wants attention, or something is due, or something else may be new."""
        readable: list[HasFileno] = [stop, self._port] if self._present else [stop]
        writable: list[HasFileno] = [self._port] if self._present and self._device.transmission.host else []
        longest = LONGEST_WAIT_S if self._present else HOST_POLL_S
        wait_for(readable, writable, min(max(self._pace.wait_s(), 0.0), longest))

    def drain(self, stop: Stop) -> None:
        """Tell the host that no frame follows, and let it read to the end, as long as it goes on reading.

        A host that has understood hangs up. To one that is still there behind a lossy line it is said again. A board
        that was switched off says nothing, since it may come back.
        """
        self._pace.finish()
        self.exchange()
        if stop.is_set():
            return
        said = self._device.say_over(self._pace.now_us())
        say_again_until = time.monotonic() + (LISTENER_S if self._device.may_lose else 0.0)

        def to_say() -> bool:
            return not said or time.monotonic() < say_again_until

        for _ in patience(lambda: (len(self._device.transmission) + to_say(), self._port.unread())):
            self.exchange()
            if stop.is_set() or not self._present:
                return
            if to_say() and not len(self._device.transmission):
                said = self._device.say_over(self._pace.now_us())
            wait_for([stop], [], HOST_POLL_S)

    def _follow_cable(self) -> bool:
        """Take the port away or bring it back as the scene says; whether it is there."""
        unplugged = self._device.unplugged()
        if unplugged and self._plugged:
            self._name = self._device.new_name()
            self._port.unplug()
            self._plugged = self._present = False
            self._device.transmission.clear(self._pace.now_us())
        elif not unplugged and not self._plugged:
            self._port.plug_in(self._name)
            self._plugged = True
            # The cable is also the supply: the board starts anew.
            self._device.reset("", self._pace.now_us())
        return self._plugged

    def _host_arrived(self, now_us: float) -> None:
        self._port.take_reset()  # the level on opening is no edge beside the one taken here
        if self._auto_reset:
            self._device.reset("", now_us)
        self._device.transmission.offer(b"\0", now_us)  # ends what may have been cut off for the last host
        self._pace.host_arrived()

    def _deliver(self, now_us: float) -> None:
        self._device.advance(now_us)
        self._device.steal()
        arrived = self._device.arrived()
        if arrived:
            sampled = self._device.as_sampled(arrived, self._port.baud_rate())
            self._device.transmission.taken(self._port.write(sampled))


class _RealPace:
    """When to tick, and what the line time is: the machine's."""

    def __init__(self, device: Device, outcome: Outcome) -> None:
        self._device, self._outcome = device, outcome
        self._start = time.monotonic()

    def now_us(self) -> float:
        """Line time."""
        return 1e6 * (time.monotonic() - self._start)

    def host_arrived(self) -> None:
        """A host has opened the port."""

    def host_spoke(self) -> None:
        """The host has sent something."""

    def finish(self) -> None:
        """No more ticks will come: what is on the line arrives."""

    def due(self, *, host_present: bool) -> bool:
        """Whether the next tick is due now."""
        late_s = (self.now_us() - self._device.next_us) / 1e6
        if late_s > MOST_BEHIND_S:
            self._device.fall_behind(1e6 * late_s)
            self._outcome.behind_s += late_s
        return late_s >= 0 and self._device.board.is_ready

    def wait_s(self) -> float:
        """How long nothing can become due by itself."""
        if not self._device.board.is_ready:
            return SOON_S
        now_us = self.now_us()
        return (min(self._device.next_us, self._device.transmission.next_us(now_us)) - now_us) / 1e6


class _FastPace(_RealPace):
    """As fast as the host takes the bytes."""

    def __init__(self, device: Device, outcome: Outcome) -> None:
        super().__init__(device, outcome)
        self._orders = 0
        self._silent_until = inf
        self._line_us = 0.0

    def now_us(self) -> float:
        # Time stands still between ticks, unless bytes are on the line: then it goes on to their arrival.
        transmission = self._device.transmission
        self._line_us = max(self._line_us, self._device.next_us)
        if not self._device.board.wants_tick and not transmission.host:
            arrival_us = transmission.next_us(self._line_us)
            if arrival_us < inf:
                self._line_us = max(self._line_us, arrival_us)
        return self._line_us

    def host_arrived(self) -> None:
        # Serial programs discard what came before they were ready: say nothing until they are.
        self._device.board.streaming = False
        self._orders = self._device.board.orders
        self.host_spoke()

    def host_spoke(self) -> None:
        self._silent_until = time.monotonic() + LISTENER_S

    def due(self, *, host_present: bool) -> bool:
        board = self._device.board
        if self._device.unplugged():
            return True
        if not host_present:
            return False
        if board.orders == self._orders and time.monotonic() >= self._silent_until:
            board.streaming = board.streams_unasked
        return board.wants_tick and len(self._device.transmission.host) < PIECE

    def wait_s(self) -> float:
        return HOST_POLL_S

    def finish(self) -> None:
        self._line_us = inf


def patience(unread: Callable[[], tuple[int, int]]) -> Iterator[None]:
    """Steps to wait for a host that reads to the end: until nothing is left, or until it has long stopped reading.

    Args:
        unread: bytes that wait before the port and behind it.

    """
    left, ends_at, quiet = None, 0.0, 0
    while quiet < 3:
        yield
        before, left = left, unread()
        now = time.monotonic()
        if left != before:
            ends_at = now + DRAIN_S
        elif now > ends_at:
            return
        # The kernel moves bytes on in steps: empty for a moment is not empty yet.
        quiet = quiet + 1 if left == (0, 0) else 0
