"""``BoardSkin``: the skin behind one board. It turns a board's bytes into frames of counts, ohms and kPa."""

from __future__ import annotations

import copy
import os
import weakref
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import NoReturn, Self, Unpack

from ..circuits import Design
from ..common.checks import count, function, loaded, number, of_kind, positive
from ..common.geometry import Geometry
from ..common.text import printable
from ..errors import InputError, LinkEnded, LinkError
from ..wire import Description, Identity, Order
from ._consumer import AsyncFrames, Consumer, FrameCallback, Source, follower, frames_since
from ._contacts import Touch
from ._convert import Converter
from ._frame import Frame
from ._options import Options, SkinSettings
from ._orders import Answer
from ._port import Arrival, BytePort
from ._port_names import usb_serial_number
from ._recording import Recording
from ._replay import RecordedSettings, ReplayPort
from ._set_up import begin, connect
from ._statistics import LinkStatistics
from ._tare import Tare
from ._taring import Tares
from ._tuning import KNOWN_DRIFT, MANY, MAX_AGE_S, SPREAD


class BoardSkin:
    """An open skin: iterate over it for its frames. Make one with :meth:`open`.

    A thread reads the port as long as the skin is open. :meth:`read`, :meth:`latest` and iteration share one place in
    the stream; each callback, each ``async for`` and each :meth:`frames` has a place of its own. Every method may be
    called from every thread.
    """

    def __init__(
        self,
        port: BytePort,
        *,
        reopen: Callable[[], BytePort] | None = None,
        record: str | Path | None = None,
        overwrite: bool = False,
        **settings: Unpack[SkinSettings],
    ) -> None:
        """Wait until the board behind an open port has identified itself, and set up the conversion of its frames.

        Args:
            port: an open port. :meth:`close` closes it, and so does an error here.
            reopen: function that opens the port again; None: a lost port is not opened again.
            record: MCAP file to record to, from the first byte; the recording ends with the skin.
            overwrite: replace a recording that is there already.
            settings: see :class:`SkinSettings`.

        Raises:
            LinkTimeout: the board is silent.
            ProtocolError: the board sends something other than packets, or an invalid or too large description.
            LinkError: the port is gone.
            InputError: there is no such family, or no such estimator for this cell; the design is not known; the
                accuracy is not between 0 and 1, or another number is not possible; a file cannot be read; the recording
                cannot be written or exists already; or the calibration belongs to another board.

        """
        try:
            options = Options.of(**settings)
        except BaseException:
            port.close()
            raise
        self._begin(port, options, reopen, record, overwrite=overwrite)

    def _begin(
        self,
        port: BytePort,
        options: Options,
        reopen: Callable[[], BytePort] | None,
        record: str | Path | None,
        *,
        overwrite: bool,
    ) -> None:
        """Identify the board as asked; on failure the port is closed."""
        settings = replace(options.settings, simulated=getattr(port, "is_simulated", False))
        self._timeout = options.timeout_s
        self._recorder: Recording | None = None
        try:
            self._connection = connect(port, options, reopen)
            if record is not None:
                self._recorder = Recording(record, settings.as_metadata(), overwrite=overwrite)
        except BaseException:
            port.close()
            raise
        if self._recorder is not None:
            self._connection.record(self._recorder)
        try:
            begin(self._connection, port, options)
            if self._recorder is not None:
                self._recorder.keep()
        except BaseException:
            self._connection.stop()
            if self._recorder is not None:
                self._recorder.discard()
            raise
        self._source: Source = self._connection
        self._frames = self._source.frames
        self.settings = settings
        """settings with which the skin was opened, for recordings"""
        self.family = options.family
        self.cell = self._converter.cell
        """model of the skin's material; None: not known, pressures are NaN"""
        self.calibration = settings.calibration
        """rest resistances and gains of the cells; None: all cells are as the cell model says"""
        self.recorded_s = port.seconds if isinstance(port, ReplayPort) else None
        """duration of the recording in s; None: the board is live"""
        self._consumer = Consumer(self._source, after=0)
        self._callbacks: list[FrameCallback] = []
        self._tares = Tares(self._frames, self._consumer, self.calibration)
        if self._recorder is not None:
            self._connection.record_frames(self._recorder, follower(self._connection, self._recorder.frame))
        _OPEN_HERE.add(self)
        weakref.finalize(self, self._connection.forget).atexit = False

    @property
    def _converter(self) -> Converter:
        return self._connection.frames.converter

    def _must_be(self, serial_number: str | None) -> None:
        """Close the skin and raise LinkError if neither the board nor its USB device has that serial number.

        A board that sends no serial number passes.
        """
        if serial_number is not None and serial_number not in (
            self.serial_number or serial_number,
            usb_serial_number(self.port_name),
        ):
            self.close()
            raise LinkError(f"{self.port_name}: board {self.serial_number} is there; expected {serial_number}")

    @property
    def boards(self) -> tuple[BoardSkin, ...]:
        """The skin of each board: this one, unless it has several (:class:`.JoinedSkin`)."""
        return (self,)

    @property
    def serial_number(self) -> str:
        """The board's serial number; empty if the board does not send one."""
        return self._connection.handshake.serial_number

    @property
    def identity(self) -> Identity | None:
        """The board's identity packet; None if the board does not send one."""
        return self._connection.handshake.identity

    @property
    def description(self) -> Description | None:
        """The board's data sheet; None when it was not needed, or the family has none."""
        return self._connection.handshake.description

    @property
    def knows_circuit(self) -> bool:
        """Whether the board's readout circuit is known; otherwise frames have counts only."""
        return self._converter.design is not None

    @property
    def design(self) -> Design:
        """The board's readout circuit. InputError where it is not known."""
        if self._converter.design is None:
            raise InputError(
                f"{self.port_name}: the circuit of board '{self.family.name}' is not known; expected a design "
                "(--design DESIGN.toml, or design = in BOARD.toml)"
            )
        return self._converter.design

    @property
    def circuit_name(self) -> str | None:
        """Of the readout; None where it is not known."""
        return self.design.board.circuit.name if self.knows_circuit else None

    @property
    def count_bits(self) -> int:
        """Bits of a count."""
        adc = self.design.adc if self.knows_circuit else None
        return self.family.layout.adc_bits if adc is None else adc.bits

    @property
    def full_scale_kpa(self) -> float | None:
        """Of the cells; None: not known."""
        return None if self.cell is None else self.cell.full_scale_kpa

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the array."""
        return self._converter.shape

    @property
    def port_name(self) -> str:
        """Name of the port; after a reconnection, of the one where the board is now."""
        return self._source.port_name

    @property
    def geometry(self) -> Geometry:
        """Places and areas of the cells, and where there is none."""
        return self._converter.geometry

    @property
    def pitch_m(self) -> float:
        """Distance of neighbouring cells in m. InputError where cells are not square, or the skin is no rectangle."""
        x_m, y_m = self.pitch_xy_m
        if x_m != y_m:
            raise InputError(f"{self.port_name}: cells of {x_m} x {y_m} m have no single pitch; use pitch_xy_m")
        return x_m

    @property
    def pitch_xy_m(self) -> tuple[float, float]:
        """Distances of neighbouring cells in m along a row (x) and along a column (y). InputError: no rectangle."""
        pitch = self.geometry.pitch_m
        if pitch is None:
            raise InputError(f"{self.port_name}: cells with a [shape] have no pitch; use geometry")
        return pitch

    @property
    def away(self) -> str | None:
        """Why the port is lost, while the driver tries to open it again; None: the port is there."""
        return self._frames.away

    def __repr__(self) -> str:
        """Port, array, and state of the link, as a notebook shows a skin."""
        rows, columns = self.shape
        number = f", serial number {printable(self.serial_number)}" if self.serial_number else ""
        state = "over" if self._frames.end is not None else "open" if self.away is None else "away"
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
        """Release the port; may be called from any thread. Iterations end; the board keeps running.

        Raises:
            InputError: a recording could not be written to its end.

        """
        for callback in self._callbacks:
            callback.end()
        self._connection.stop()
        for callback in self._callbacks:
            callback.close()
        self._callbacks.clear()
        self._recorder = None
        for recording in tuple(self._connection.recordings):
            recording.close()

    def _disown(self) -> None:
        """In a forked process: tell every reader that the skin belongs to the parent process."""
        self._tares.disown()
        for recording in self._connection.recordings:
            recording.disown()
        self._callbacks.clear()
        self._connection.disown()

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        """Wait for the next frame; StopIteration at the regular end, or when the skin is closed.

        Raises:
            LinkTimeout: no frame came in time, though the port is there.
            LinkError: the board has gone away, and has not come back.
            ProtocolError: the bytes break the format, or the counts do not fit the design. A later frame may be good.

        """
        try:
            return self._consumer.next_frame(self._timeout, while_away=True)
        except LinkEnded:
            raise StopIteration from None

    def __aiter__(self) -> AsyncIterator[Frame]:
        """The frames from now on, for ``async for``; ends and raises as iteration does."""
        return AsyncFrames(self._source, self._timeout, keep=self)

    def frames(self) -> Iterator[Frame]:
        """An iterator with a place of its own, from now on: frames that other readers take do not go missing here."""
        return self._follow(Consumer(self._source))

    def _follow(self, consumer: Consumer) -> Iterator[Frame]:
        try:
            while True:
                try:
                    yield consumer.next_frame(self._timeout, while_away=True)
                except LinkEnded:
                    return
        finally:
            consumer.leave()

    def read(self, timeout: float | None = None) -> Frame:
        """Wait up to ``timeout`` s for the next frame (None: the timeout with which the skin was opened).

        A timeout of 0 or less does not wait: a frame that is there is returned, else LinkTimeout is raised.

        Raises:
            LinkTimeout: no frame came in time.
            LinkEnded: no frame will come: the stream is over, or the skin is closed.
            LinkError, ProtocolError: as for iteration.
            InputError: ``timeout`` is no number.

        """
        return self._consumer.next_frame(self._timeout if timeout is None else number("timeout", timeout, "s"))

    def read_many(self, most: int = MANY, timeout: float | None = None) -> list[Frame]:
        """Wait as :meth:`read` for the next frame, and take those after it that have come already.

        These are the frames that as many calls of :meth:`read` would give, bit for bit, but they are converted at once:
        for recordings, and for programs that look at the skin now and then.

        Args:
            most: frames, at most.
            timeout: s, as for :meth:`read`.

        Raises:
            LinkTimeout, LinkEnded, LinkError, ProtocolError, InputError: as :meth:`read`. What came before an error is
                returned first.

        """
        timeout_s = self._timeout if timeout is None else number("timeout", timeout, "s")
        return self._consumer.next_frames(count("most", most), timeout_s)

    def latest(self, max_age: float = MAX_AGE_S, timeout: float = 0.0) -> Frame:
        """The newest frame, taken before or not, never older than ``max_age``. For control loops.

        Args:
            max_age: s since the arrival of the frame's last byte, at most; infinite for a frame however old.
            timeout: s to wait if there is no such frame; 0 or less: do not wait.

        Raises:
            LinkTimeout: there is no such frame; the message gives the age of the newest one.
            LinkEnded, LinkError, ProtocolError: as for :meth:`read`.
            InputError: ``max_age`` is not above 0, or ``timeout`` is no number.

        """
        return self._consumer.latest(positive("max_age", max_age, "s"), number("timeout", timeout, "s"))

    def frames_since(self, monotonic_time: float) -> list[Frame]:
        """All frames that came after a moment, the oldest first: for a policy at 30 Hz with a skin at 150 Hz.

        Frames are not taken from other readers by that, and may be asked for again. The last ``queue`` frames are kept;
        with ``lossless``, of those that some reader has taken. What the first frame says of losses counts from the
        frame before it, if that is still kept.

        Args:
            monotonic_time: s on the clock of :attr:`Frame.monotonic_time` and of :func:`time.monotonic`, such as that
                of the newest frame of the last call, or of the last image.

        Raises:
            InputError: ``monotonic_time`` is no number.
            LinkEnded, LinkError: as for :meth:`read`, where there is no such frame.

        """
        frames = frames_since(self._source, number("monotonic_time", monotonic_time, "s"))
        if not frames and self._frames.end is not None:
            raise copy.copy(self._frames.end)
        return frames

    def on_frame(
        self, callback: Callable[[Frame], None], on_end: Callable[[Exception], None] | None = None
    ) -> FrameCallback:
        """Call ``callback`` with each frame from now on, one at a time, in a thread of its own.

        Args:
            callback: takes a frame.
            on_end: called once in the same thread when no frame will come any more, with the reason: a
                :class:`~ohmskin.errors.LinkEnded` at the regular end, else a :class:`~ohmskin.errors.LinkError`; or
                with the exception of a callback that failed. Not called when ``close()`` of the skin or of the returned
                object ends the calls.

        Returns:
            An object whose ``close()`` ends the calls. An exception in the callback ends them, too.

        Raises:
            InputError: ``callback`` or ``on_end`` is no function.

        """
        made = FrameCallback(Consumer(self._source), self.port_name, callback, on_end, keep=self)
        # Dropping callbacks that have ended releases the objects to which they refer.
        self._callbacks = [earlier for earlier in self._callbacks if not earlier.is_over] + [made]
        return made

    def on_bytes(self, tap: Callable[[Arrival], None]) -> None:
        """Call ``tap`` with all bytes from now on, as they arrive, in the reader thread: for recorders.

        Raises:
            InputError: ``tap`` is no function.

        """
        function("tap", tap)
        self._connection.taps.append(tap)

    @property
    def estimator_name(self) -> str:
        """Name of the estimator that computes pressures; empty where there are none."""
        return self._converter.estimator_name

    @property
    def touch(self) -> Touch:
        """By what contacts are told from an untouched skin."""
        return self._converter.touch

    @property
    def recorder(self) -> Recording | None:
        """The recording that the skin was opened with."""
        return self._recorder

    def settings_to_join(self) -> RecordedSettings:
        """The settings for a recording that begins now, with what the board has said of itself."""
        return replace(self.settings, introduction=self._connection.handshake.as_bytes())

    def attach(self, recording: Recording) -> None:
        """Begin a recording here; :class:`Recorder` calls this.

        Frames that have come already are converted first.

        Raises:
            LinkError: the skin has come to its end, or is closed.

        """
        with self._connection.between_arrivals():
            if self._frames.end is not None:
                raise copy.copy(self._frames.end)
            newest = self._frames.newest
            if newest is not None:
                self._frames.measure(newest)
            recording.begin_after(self._frames.counters.frames, self._converter.rest)
            if self._connection.away:
                recording.port_gone()
            self._connection.record(recording)
            self._connection.record_frames(recording, follower(self._connection, recording.frame))

    def request(self, order: Order, *, period_us: int = 0, timeout: float | None = None) -> Answer | None:
        """Give the board an order of its protocol, and return its answer. After STOP no frames come until START.

        Args:
            order: what the board shall do.
            period_us: us between two frames, for RATE.
            timeout: s to wait for the answer (None: the timeout with which the skin was opened); the order is repeated
                meanwhile, since lines lose packets.

        Returns:
            A :class:`ohmskin.wire.Reply`, matched by the order's number; for IDENTIFY, DESCRIBE, SELF_TEST and
            ONE_FRAME the packet that was asked for. None for families of boards whose orders have no answers.

        Raises:
            OrderRefused: the board has refused the order; the message says why.
            LinkTimeout: no answer came.
            LinkEnded: the skin is closed, or the stream is over.
            LinkError: the port is gone, or the line is full.
            InputError: ``order`` is no :class:`ohmskin.wire.Order`, or the family has no such order; ``period_us`` or
                ``timeout`` is no number; a recording plays.

        """
        of_kind("order", order, Order, "an ohmskin.wire.Order")
        number("period_us", period_us, "us")
        if self.recorded_s is not None:
            raise InputError(f"{self.port_name}: a recording takes no orders")
        limit_s = self._timeout if timeout is None else number("timeout", timeout, "s")
        return self._connection.order(order, limit_s, period_us=period_us)

    def stats(self) -> LinkStatistics:
        """Statistics of the link: frames received and lost, and their ages."""
        clock = self._connection.stream.clock
        return self._frames.counters.snapshot(
            skipped=self._frames.skipped, drift_ppm=clock.drift_ppm, clock_steps=clock.steps
        )

    def tare(
        self, frames: int = 20, *, force: bool = False, drift: float = KNOWN_DRIFT, spread: float = SPREAD
    ) -> Tare:
        """Take the skin as unloaded: the mean of the next ``frames`` frames becomes each cell's rest resistance.

        A tare removes the differences between cells, and the constant part of circuit effects that the design leaves
        out. A cell without a valid reading gets its rest resistance from the calibration, in proportion to the other
        cells, else from the data sheet. Where noise may be the reason, a ``RuntimeWarning`` and the result's ``covers``
        say how many frames would measure the cell. Iteration does not yield the frames of the tare; frames lost
        meanwhile count in the next frame's ``lost_before``.

        Args:
            frames: number of frames to average.
            force: tare in spite of signs of a load; the result's ``remarks`` then list these signs.
            drift: relative change of a rest resistance, since the tare or calibration in use, that temperature and age
                explain. A larger change is a sign of a load. A forced tare is not compared with.
            spread: relative deviation of a cell from the typical cell, or from its ratio to that cell in the
                calibration, that manufacturing tolerances explain. A larger deviation is a sign of a load.

        Raises:
            InputError: the skin seems to be loaded (resistances far from the data sheet, unlike each other, changing,
                or unlike those of the tare or calibration in use); noise alone may give that impression (the message
                says how many frames decide); no cell has a valid reading; or ``frames``, ``drift`` or ``spread`` is
                not positive.
            LinkTimeout, LinkError, ProtocolError: as for :meth:`read`.

        """
        return self._tares.take(
            count("frames", frames),
            self._timeout,
            serial_number=lambda: self._connection.serial_number(0.0),
            board=self.port_name,
            drift=positive("drift", drift),
            spread=positive("spread", spread),
            force=force,
        )

    @property
    def tared(self) -> Tare | None:
        """The tare in use; None: rest resistances are those of the calibration, else of the data sheet.

        A replayed recording applies its own tares to its frames; they do not appear here.
        """
        return self._tares.in_use

    def use_tare(self, tare: Tare | str | Path | None) -> None:
        """Use an earlier tare.

        Args:
            tare: a tare, or a file written by :meth:`Tare.save`; None: the rest resistances from before any tare.

        Raises:
            InputError: the tare is of another board or of an array of another shape, or the file holds no tare.

        """
        given = None if tare is None else loaded("tare", tare, Tare)
        compared = given is not None and bool(given.serial_number)
        number = self._connection.serial_number(self._timeout) if compared else ""
        self._tares.use(given, serial_number=number)

    def undo_tare(self) -> Tare | None:
        """Return to the previous tare. Returns the tare then in use, None for none."""
        return self._tares.undo()


_OPEN_HERE: weakref.WeakSet[BoardSkin] = weakref.WeakSet()
"""skins that this process has opened"""


def _disown_skins() -> None:
    """In a forked process: threads do not survive a fork, and the parent's port is not the child's to read."""
    for skin in list(_OPEN_HERE):
        skin._disown()


if hasattr(os, "register_at_fork"):  # POSIX
    os.register_at_fork(after_in_child=_disown_skins)
