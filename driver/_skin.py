"""``Skin``: the driver's face. A board's bytes to frames of counts, ohms and kPa."""

from __future__ import annotations

import copy
import os
import weakref
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import NoReturn, Self

from .. import compiled
from ..cell import Cell
from ..checks import count, function, loaded, number, of_kind, path_text, positive
from ..circuits import Design
from ..errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError, ProtocolError
from ..text import printable
from ..wire import Description, Family, Identity, Order
from ._calibration import Calibration
from ._convert import Measurement
from ._discover import LONGEST_SEARCH_S, find_board
from ._frame import Frame
from ._opening import QUEUE, Delivery, Link, Opening
from ._past import Past
from ._port import Arrival, BytePort
from ._port_names import has_gone, refuse_missing, usb_serial_number
from ._reader import await_free
from ._reconnect import PortFinder
from ._recording import Recording
from ._replay import NOTHING_RECORDED, ReplayPort
from ._statistics import LinkStatistics
from ._stream import RawFrame
from ._taker import AsyncFrames, ConvertedFrames, FrameCallback, FrameTaker
from ._tare import KNOWN_DRIFT, SPREAD, Tare
from ._taring import Tares


class Skin:
    """An open skin: iterate over it for its frames. Make one with :meth:`open`.

    A thread reads the port as long as the skin is open. :meth:`read`, :meth:`latest` and iteration share one place in
    the stream; each callback, each ``async for`` and each :meth:`frames` has a place of its own. Every method may be
    called from every thread.
    """

    def __init__(
        self,
        port: BytePort,
        *,
        board: str | Family = "ohmskin",
        design: Design | str | Path | None = None,
        cell: Cell | str | Path | None = None,
        estimator: str | None = None,
        timeout: float = 3.0,
        delivery: Delivery = "newest",
        queue: int = QUEUE,
        reconnect: float = 10.0,
        reopen: Callable[[], BytePort] | None = None,
        pitch: float | tuple[float, float] | None = None,
        accuracy: float | None = None,
        record: str | Path | None = None,
        overwrite: bool = False,
        calibration: Calibration | str | Path | None = None,
    ) -> None:
        """Introduce the board behind an open port.

        Args:
            port: closed by :meth:`close`, and when this fails.
            board: family of the board, by name (``ohmskin.wire.BOARDS``) or itself.
            design: how the board reads its array, or its DESIGN.toml; None: as the board describes itself, or as is
                usual for its family.
            cell: what the skin is made of, or its CELL.toml; None: as the board describes itself. Without both,
                pressures are NaN.
            estimator: name for :meth:`ohmskin.cell.Cell.estimator`.
            timeout: s to wait for the board to introduce itself, then of processor time for the inverse of its circuit
                to be set up (at most ten times as long on a busy machine), and later s to wait for each frame. The
                compiler (extra ``fast``) may take longer, once on a machine.
            delivery: which frames readers get, see :data:`Delivery`.
            queue: frames that wait for readers, unless ``delivery`` is ``newest``.
            reconnect: s to try to open a port again that has gone away.
            reopen: opens the port again; None: a port that has gone away is not opened again.
            pitch: distance of neighbouring cells in m, for contacts; of cells that are not square (x, y), along a row
                and along a column. None: that of the design's ``[sheet]``.
            accuracy: relative uncertainty of a cell's conductance up to which the cell is valid; None: 0.5, see
                :class:`ohmskin.circuits.ValidityRule`.
            record: MCAP file to record to, from the first byte; the recording ends with the skin.
            overwrite: replace a recording that is there already.
            calibration: rest resistance and gain of each cell, or the file that holds them. A tare replaces its rest
                resistances and keeps its gains.

        Raises:
            LinkTimeout: the board is silent.
            ProtocolError: it sends something else than packets, or a description that is not valid or too large.
            LinkError: the port is gone.
            InputError: there is no such family, or no such estimator for this cell, or the design is not known, or
                the accuracy is not between 0 and 1, or another number cannot be, or a file cannot be read, or the
                recording cannot be written or is there already, or the calibration is another board's.

        """
        try:
            opening = Opening.of(
                board=board,
                design=design,
                cell=cell,
                estimator=estimator,
                pitch=pitch,
                accuracy=accuracy,
                calibration=calibration,
                timeout=timeout,
                delivery=delivery,
                queue=queue,
                reconnect=reconnect,
            )
        except BaseException:
            port.close()
            raise
        self._begin(port, opening, reopen, record, overwrite=overwrite)

    def _begin(
        self,
        port: BytePort,
        opening: Opening,
        reopen: Callable[[], BytePort] | None,
        record: str | Path | None,
        *,
        overwrite: bool,
    ) -> None:
        """Introduce the board as asked; a port whose board cannot be introduced is closed."""
        self._timeout, self._delivery = opening.timeout_s, opening.delivery
        self._recorder: Recording | None = None
        self._followers: dict[Recording, Callable[[RawFrame, Measurement], None]] = {}
        """recordings under way -> what tells them of converted frames"""
        try:
            link = Link(port, opening, reopen)
            if record is not None:
                self._recorder = link.record(record, overwrite=overwrite)
        except BaseException:
            port.close()
            raise
        try:
            self._converter = link.introduce()
            if self._recorder is not None:
                self._recorder.keep()
        except BaseException:
            link.reader.stop()
            if self._recorder is not None:
                self._recorder.discard()
            raise
        self._reader, self._mailbox, self._counters = link.reader, link.mailbox, link.counters
        self.settings = opening.settings
        """how the skin was opened, for recordings"""
        self.family = opening.family
        self.design = self._converter.design
        """how the board reads its array"""
        self.cell = self._converter.cell
        """what the skin is made of; None: not known, pressures are NaN"""
        self.calibration = opening.settings.calibration
        """rest resistances and gains of the cells; None: all are as the cell's data say"""
        self.recorded_s = port.seconds if isinstance(port, ReplayPort) else None
        """s that the recording lasts; None: the board is live"""
        self._source = link.source(self._converter)
        self._taker = FrameTaker(self._source, from_start=True)
        self._callbacks: list[FrameCallback] = []
        self._tares = Tares(self._converter, self._taker, self.calibration)
        if self._recorder is not None:
            self._follow_frames(self._recorder)
        _OPEN_HERE.add(self)
        weakref.finalize(self, self._reader.forget).atexit = False

    @classmethod
    def open(
        cls,
        port: str | Path | None = None,
        *,
        board: str | Family = "ohmskin",
        serial_number: str | None = None,
        design: Design | str | Path | None = None,
        cell: Cell | str | Path | None = None,
        estimator: str | None = None,
        timeout: float = 3.0,
        baudrate: int | None = None,
        delivery: Delivery | None = None,
        queue: int = QUEUE,
        reconnect: float = 10.0,
        pitch: float | tuple[float, float] | None = None,
        accuracy: float | None = None,
        record: str | Path | None = None,
        overwrite: bool = False,
        speed: float | None = None,
        calibration: Calibration | str | Path | None = None,
    ) -> Skin:
        """Open a serial device, a pty, ``socket://HOST:PORT`` or a recording; see :meth:`__init__` for the rest.

        A recording, a file that ends in ``.mcap``, is opened as its skin was, with all that is not given here.

        Args:
            port: name of the port; None: the port where :func:`discover` finds the board ``serial_number``.
            board: family of the board.
            serial_number: that the board must have.
            design: and the others: as for :meth:`__init__`.
            cell: likewise.
            estimator: likewise.
            timeout: likewise.
            baudrate: of the UART, where there is one; None: that of the family.
            delivery: likewise; None: ``newest``, and ``lossless`` for a recording.
            queue: likewise.
            reconnect: likewise.
            pitch: likewise.
            accuracy: likewise.
            record: likewise.
            overwrite: likewise.
            speed: of a recording, times real time; None: as fast as it is read. A live board has its own pace.
            calibration: as for :meth:`__init__`; None: that of the recording, else none.

        Raises:
            LinkError: the port is not there, may not be used, or is in use, or another board is behind it; and what
                :meth:`__init__` raises.
            InputError: ``speed`` is given and ``port`` is no recording; and what :meth:`__init__` raises.

        """
        finder: PortFinder | None = None
        opened: BytePort
        reopen: Callable[[], BytePort]
        name = None if port is None else path_text("port", port, "the name of a port or of a recording")
        played = ReplayPort(name, speed) if name is not None and name.endswith(".mcap") else None
        if played is None and speed is not None:
            raise InputError(f"speed is {speed}, but only a recording (a file that ends in .mcap) has one")
        recorded = NOTHING_RECORDED if played is None else played.settings
        usual: Delivery = "newest" if played is None else "lossless"
        # All that can be wrong with what is asked is told before anybody waits for a board or for the compiler.
        asked = Opening.of(
            board=board if played is None else recorded.board,
            design=recorded.design if design is None else design,
            cell=recorded.cell if cell is None else cell,
            estimator=recorded.estimator if estimator is None else estimator,
            pitch=recorded.pitch if pitch is None else pitch,
            accuracy=recorded.accuracy if accuracy is None else accuracy,
            calibration=recorded.calibration if calibration is None else calibration,
            timeout=timeout,
            delivery=usual if delivery is None else delivery,
            queue=queue,
            reconnect=reconnect,
            serial_number=serial_number,
        )
        if record is not None:
            Recording.check(record, overwrite=overwrite)
        if played is None:
            finder = _finder(name, asked, baudrate)
            began_s = monotonic()
            compiled.load()  # while no frames come
            if has_gone(finder.name):
                raise LinkError(
                    f"{finder.name}: the port has gone in the {monotonic() - began_s:.0f} s in which machine code was "
                    "prepared, which is kept for the next time. Plug the board in, or start the emulation, again"
                )
            opened, reopen = finder.open(), finder.open_again
        else:
            opened, reopen = played, played.reopen
        skin = cls.__new__(cls)
        skin._begin(opened, asked, reopen, record, overwrite=overwrite)
        if finder is not None:
            introduction = skin._reader.introduction
            finder.board_is_numbered = lambda: bool(introduction.serial_number)
            skin._must_be(serial_number)
        return skin

    def _must_be(self, serial_number: str | None) -> None:
        """Close the skin where neither its board nor the board's USB device has that serial number; LinkError."""
        if serial_number is not None and serial_number not in (
            self.serial_number or serial_number,
            usb_serial_number(self.port_name),
        ):
            self.close()
            raise LinkError(f"{self.port_name}: board {self.serial_number} is there; expected {serial_number}")

    @property
    def serial_number(self) -> str:
        """The board's serial number; empty where it does not say."""
        return self._reader.introduction.serial_number

    @property
    def identity(self) -> Identity | None:
        """Who the board says it is; None where it does not say."""
        return self._reader.introduction.identity

    @property
    def description(self) -> Description | None:
        """The board's data sheet; None when it was not needed, or the family has none."""
        return self._reader.introduction.description

    @property
    def port_name(self) -> str:
        """The name of the port that was opened."""
        return self._source.name

    @property
    def pitch_m(self) -> float:
        """Distance of neighbouring cells in m. InputError where cells are not square: ask for :attr:`pitch_xy_m`."""
        x_m, y_m = self._converter.pitch
        if x_m != y_m:
            raise InputError(f"{self.port_name}: cells of {x_m} x {y_m} m have no single pitch; use pitch_xy_m")
        return x_m

    @property
    def pitch_xy_m(self) -> tuple[float, float]:
        """Distances of neighbouring cells in m along a row (x) and along a column (y)."""
        pitch = self._converter.pitch
        return pitch.x_m, pitch.y_m

    @property
    def away(self) -> str | None:
        """Why the port is gone, while the driver tries to open it again; None: it is there."""
        return self._mailbox.away

    def __repr__(self) -> str:
        """Port, array, and whether frames come: what a notebook shows of a skin."""
        rows, columns = self.design.array.shape
        number = f", serial number {printable(self.serial_number)}" if self.serial_number else ""
        state = "over" if self._mailbox.end is not None else "open" if self.away is None else "away"
        return f"<Skin {self.port_name}: {rows} x {columns} cells{number}; {state}>"

    def __reduce__(self) -> NoReturn:
        raise TypeError("a Skin cannot be sent to another process or be copied; send its frames, or open it there")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the port back, from any thread. Iterations end; the board goes on by itself.

        Raises:
            InputError: a recording could not be written to its end.

        """
        for callback in self._callbacks:
            callback.end()
        self._reader.stop()
        for callback in self._callbacks:
            callback.close()
        self._callbacks.clear()
        recordings, self._recorder = list(self._followers), None
        self._followers.clear()
        for recording in recordings:
            recording.close()

    def _disown(self) -> None:
        """In a forked process: every reader is told that the skin is another process's."""
        self._tares.disown()
        self._callbacks.clear()
        self._followers.clear()
        self._reader.disown()

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        """The next frame, waiting for it; StopIteration at the regular end, or when the skin is closed.

        Raises:
            LinkTimeout: none came in time, though the port is there.
            LinkError: the board has gone away, and has not come back.
            ProtocolError: what came breaks the format, or does not fit the design. A later frame may be good.

        """
        try:
            return self._taker.take(self._timeout, while_away=True)
        except LinkEnded:
            raise StopIteration from None

    def __aiter__(self) -> AsyncIterator[Frame]:
        """The frames that come from now on, for ``async for``; ends and raises as iteration does."""
        return AsyncFrames(self._source, self._timeout, keep=self)

    def frames(self) -> Iterator[Frame]:
        """An iterator with a place of its own: the frames that come from now on, whoever else takes them."""
        return self._follow(FrameTaker(self._source))

    def _follow(self, taker: FrameTaker) -> Iterator[Frame]:
        try:
            while True:
                try:
                    yield taker.take(self._timeout, while_away=True)
                except LinkEnded:
                    return
        finally:
            taker.leave()

    def read(self, timeout: float | None = None) -> Frame:
        """The next frame, waiting for it for ``timeout`` s (None: as the skin was opened).

        With 0 or less nothing is waited for: a frame that has come is returned, else LinkTimeout is raised.

        Raises:
            LinkTimeout: none came in time.
            LinkEnded: none will come: the stream is over, or the skin is closed.
            LinkError, ProtocolError: as for iteration.
            InputError: ``timeout`` is no number.

        """
        return self._taker.take(self._timeout if timeout is None else number("timeout", timeout, "s"))

    def latest(self, max_age: float, timeout: float = 0.0) -> Frame:
        """The newest frame, taken before or not, never older than ``max_age``. For control loops.

        Args:
            max_age: s that may have passed since the frame's last byte came.
            timeout: s to wait for such a frame, where there is none; 0 or less: none.

        Raises:
            LinkTimeout: there is none; the message says how old the newest is.
            LinkEnded, LinkError, ProtocolError: as for :meth:`read`.
            InputError: ``max_age`` is not above 0, or ``timeout`` is no number.

        """
        return self._taker.latest(positive("max_age", max_age, "s"), number("timeout", timeout, "s"))

    def on_frame(
        self, callback: Callable[[Frame], None], on_end: Callable[[OhmskinError], None] | None = None
    ) -> FrameCallback:
        """Call ``callback`` with each frame from now on, one at a time, in a thread of its own.

        Args:
            callback: takes a frame.
            on_end: called once in the same thread when no frame will come any more, with the reason: a
                :class:`~ohmskin.errors.LinkEnded` at the regular end, else a :class:`~ohmskin.errors.LinkError`. Not
                called when ``close()`` of the skin or of the returned object ends the calls.

        Returns:
            An object whose ``close()`` ends the calls. An exception in the callback ends them too.

        Raises:
            InputError: ``callback`` or ``on_end`` is no function.

        """
        made = FrameCallback(self._source, callback, on_end, keep=self)
        # What a callback that has ended refers to is not the skin's to keep.
        self._callbacks = [earlier for earlier in self._callbacks if not earlier.is_over] + [made]
        return made

    def on_bytes(self, tap: Callable[[Arrival], None]) -> None:
        """Call ``tap`` with all bytes from now on, as they arrive, in the thread that reads them: for recorders.

        Raises:
            InputError: ``tap`` is no function.

        """
        function("tap", tap)
        self._reader.taps.append(tap)

    @property
    def recorder(self) -> Recording | None:
        """The recording that the skin was opened with."""
        return self._recorder

    def attach(self, recording: Recording) -> None:
        """Let a recording begin here; :class:`Recorder` calls this.

        Frames that have come are converted first. The next frames are converted by an inversion of the circuit that
        begins anew and an estimator that goes on, as in the replay.

        Raises:
            LinkError: the skin has come to its end, or is closed.

        """
        with self._reader.between_arrivals() as heard:
            if self._mailbox.end is not None:
                raise copy.copy(self._mailbox.end)
            newest = self._mailbox.newest
            if newest is not None:
                try:
                    self._converter.measure(newest, self._mailbox)
                except ProtocolError as error:
                    self._mailbox.report(error)
            past = Past.of(heard, self._reader.stream.state(), self._converter.hand_over())
            recording.joined(past)
            if self._reader.away:
                recording.port_gone()
            self._reader.taps.append(recording.arrived)
            self._reader.on_gone.append(recording.port_gone)
            self._follow_frames(recording)

    def detach(self, recording: Recording) -> None:
        """Let a recording end here; one that is not attached is left alone."""
        with self._reader.between_arrivals():
            told = self._followers.pop(recording, None)
            if told is None:
                return
            self._reader.taps.remove(recording.arrived)
            self._reader.on_gone.remove(recording.port_gone)
            self._converter.on_rest.remove(recording.rest_changed)
            self._converter.on_converted.remove(told)

    def _follow_frames(self, recording: Recording) -> None:
        told = ConvertedFrames(self._source, recording.frame).converted
        self._followers[recording] = told
        self._converter.on_rest.append(recording.rest_changed)
        self._converter.on_converted.append(told)

    def request(self, order: Order, *, period_us: int = 0) -> None:
        """Give the board an order of its protocol.

        Raises:
            LinkEnded: the skin is closed, or the stream is over.
            LinkError: the port is gone, or the line is full.
            InputError: ``order`` is no :class:`ohmskin.wire.Order`, or ``period_us`` no number.

        """
        of_kind("order", order, Order, "an ohmskin.wire.Order")
        number("period_us", period_us, "us")
        self._reader.send(order, period_us=period_us)

    def stats(self) -> LinkStatistics:
        """What came, what was lost, and how old frames were."""
        with self._mailbox.lock:
            newest = self._mailbox.newest
            pending = 0 if newest is None else newest.index - min(self._converter.last_index, newest.index)
        clock = self._reader.stream.clock
        return self._counters.snapshot(
            pending=min(pending, self._mailbox.capacity), drift_ppm=clock.drift_ppm, clock_steps=clock.steps
        )

    def tare(
        self, frames: int = 20, *, force: bool = False, drift: float = KNOWN_DRIFT, spread: float = SPREAD
    ) -> Tare:
        """Take the skin for unloaded now: the mean of the next ``frames`` becomes each cell's rest resistance.

        This removes what differs from cell to cell, and the steady part of what the design does not mention. A cell
        without a valid reading keeps the rest resistance of the calibration, else of the data sheet; where noise may be
        why, a ``RuntimeWarning`` and the result's ``covers`` say how many frames would measure it. The frames taken are
        not iterated over; frames lost meanwhile count in the next frame's ``lost_before``.

        Args:
            frames: to average.
            force: tare in spite of signs that the skin is loaded; they are then in the result's ``remarks``.
            drift: relative change of a rest resistance, since the tare or calibration in use, that temperature and age
                explain. A larger one is such a sign. A tare that was forced is not compared with.
            spread: relative deviation of a cell from the typical one, or from its share in the calibration, that
                manufacture explains. A larger one is such a sign.

        Raises:
            InputError: the skin seems to be loaded (resistances far from the data sheet, or unlike each other, or
                changing, or unlike those of the tare or calibration in use), or noise alone may let it seem so (the
                message says how many frames tell); no cell has a valid reading; or ``frames``, ``drift`` or ``spread``
                is not positive.
            LinkTimeout, LinkError, ProtocolError: as for :meth:`read`.

        """
        return self._tares.take(
            count("frames", frames),
            self._timeout,
            serial_number=lambda: self._reader.serial_number(0.0),
            board=self.port_name,
            drift=positive("drift", drift),
            spread=positive("spread", spread),
            force=force,
            waiting=self._delivery == "every",
        )

    @property
    def tared(self) -> Tare | None:
        """The tare in use; None: rest resistances are those of the calibration, else of the data sheet.

        The tares that a recording tells of are in its frames, and not here.
        """
        return self._tares.in_use

    def use_tare(self, tare: Tare | str | Path | None) -> None:
        """Use a tare from before.

        Args:
            tare: a tare, or the file that :meth:`Tare.save` wrote; None: the rest resistances from before any tare.

        Raises:
            InputError: the tare is of another board, or of an array of another shape, or the file holds none.

        """
        given = None if tare is None else loaded("tare", tare, Tare)
        compared = given is not None and bool(given.serial_number)
        number = self._reader.serial_number(self._timeout) if compared else ""
        self._tares.use(given, serial_number=number)

    def undo_tare(self) -> Tare | None:
        """Go back to the tare before the present one, None for none. Returns the tare then in use."""
        return self._tares.undo()


def _finder(port: str | None, asked: Opening, baudrate: int | None) -> PortFinder:
    """What opens the port of a board, named or looked for by its serial number; errors as :meth:`Skin.open`."""
    family = asked.family
    if baudrate is not None:
        positive("baudrate", baudrate, "bit/s")
    if port is None:
        if asked.serial_number is None:
            raise InputError("neither a port nor a serial number; expected one of them")
        port = find_board(asked.serial_number, board=family, timeout=min(asked.timeout_s, LONGEST_SEARCH_S))
    refuse_missing(port)  # before the compiler keeps anybody waiting
    await_free(port)
    return PortFinder(port, baudrate=baudrate or family.baud_rate, dtr=family.dtr, rts=family.rts)


_OPEN_HERE: weakref.WeakSet[Skin] = weakref.WeakSet()
"""skins that this process has opened"""


def _disown_skins() -> None:
    """In a forked process: threads do not survive a fork, and the parent's port is not the child's to read."""
    for skin in list(_OPEN_HERE):
        skin._disown()


if hasattr(os, "register_at_fork"):  # POSIX
    os.register_at_fork(after_in_child=_disown_skins)


__all__ = ["Delivery", "LinkTimeout", "Skin"]
