"""Opening of a skin: the caller's settings, the board's identification, and the set-up of the circuit's inverse.

:class:`Opening` holds the caller's settings, with files read and numbers checked. :class:`Link` is the reader thread
with its mailbox and counters and, once the board has identified itself, the converter of its frames.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypedDict

from ..cell import ESTIMATORS, Cell
from ..circuits import Design, Sheet, ValidityRule
from ..common.checks import count, loaded, number, of_kind, positive
from ..common.compiled import is_compiling
from ..errors import InputError, OhmskinError, ProtocolError
from ..wire import Family, HostProtocol, Layout, board_family, host_protocol
from ._calibration import Calibration
from ._convert import Converter
from ._introduce import Introduction
from ._mailbox import Mailbox
from ._pitch import Pitch
from ._port import BytePort
from ._reader import Reader
from ._recording import Recording
from ._replay import NOTHING_RECORDED, RecordedSettings, ReplayPort
from ._statistics import Counters

Delivery = Literal["newest", "every", "lossless"]
"""which frames a reader of the skin gets

``newest``
    The newest frame that the reader has not seen. Frames that came since the last one are skipped, and counted.
``every``
    Every frame, in order. A reader that is slower than the board loses the oldest of ``queue`` frames, counted.
``lossless``
    Every frame, in order. The port is not read while ``queue`` frames wait. For recordings and for emulated boards
    that wait for their host; a real board then has to drop frames itself.
"""
NATIVE = "ohmskin"
"""the family that is meant where none is named"""
QUEUE = 256
MOST_ABANDONED = 2
"""set-ups that took too long and go on for nobody: each takes a thread, and up to hundreds of MB"""
POLL_S = 0.05
"""s between checks whether the compiler is at work, and how much processor time the set-up has used"""
PATIENCE = 10.0
"""limit on the real time of a set-up that waits for the processor, over the limit on its processor time. When a robot's
computer boots, dozens of programs start at once"""


class SkinSettings(TypedDict, total=False):
    """Settings of a skin, for :class:`.Skin` and :meth:`.Skin.open`; each has a default."""

    board: str | Path | Family
    """family of the board: a name (one of ``ohmskin.wire.BOARDS``, or of an installed package), an object, or the
    BOARD.toml that describes the board; for a recording only where the recorded one is not known"""
    design: Design | str | Path | None
    """the readout circuit, as an object or as a DESIGN.toml file; None: the design that the board describes, else the
    usual one of its family, else that which BOARD.toml names. Without any frames have counts only: ``resistance`` and
    ``pressure`` are NaN, and a tare takes the counts at rest"""
    cell: Cell | str | Path | None
    """the model of the skin's material, as an object or as a CELL.toml file; None: the model that the board describes.
    Without either, pressures are NaN"""
    estimator: str | None
    """name for :meth:`ohmskin.cell.Cell.estimator`"""
    timeout: float
    """limit in s (3) for each of three things: the wait for the board to identify itself; the processor time to set up
    the inverse of its circuit (at most ten times as long on a busy machine); later the wait for each frame. The
    compiler may take longer, once on a machine"""
    delivery: Delivery | None
    """which frames readers get, see :data:`Delivery`; None: ``newest``, and ``lossless`` for a recording and for an
    emulated board that runs as fast as it is read (``ohmskin://SCENE.toml?clock=fast``)"""
    queue: int
    """number of frames that wait for readers (256), unless ``delivery`` is ``newest``"""
    reconnect: float
    """s for which the driver tries to open a lost port again (10)"""
    pitch: float | tuple[float, float] | None
    """distance of neighbouring cells in m, for contacts; for cells that are not square (x, y), along a row and along a
    column. None: the pitch in the design's ``[sheet]``"""
    accuracy: float | None
    """relative uncertainty of a cell's conductance up to which the cell is valid; None: 0.5, see
    :class:`ohmskin.circuits.ValidityRule`"""
    calibration: Calibration | str | Path | None
    """rest resistance and gain of each cell, or the file with them. A tare replaces the rest resistances and keeps its
    gains"""


@dataclass(frozen=True)
class Opening:
    """Settings of a skin, checked; see :class:`SkinSettings`."""

    family: Family
    settings: RecordedSettings
    """settings that determine the frames; a recording holds them, too"""
    timeout_s: float
    delivery: Delivery
    queue: int
    reconnect_s: float
    serial_number: str | None
    """required serial number of the board; None: any"""

    @classmethod
    def of(
        cls,
        *,
        recorded: RecordedSettings = NOTHING_RECORDED,
        recording: str = "",
        serial_number: str | None = None,
        board: str | Path | Family = NATIVE,
        design: Design | str | Path | None = None,
        cell: Cell | str | Path | None = None,
        estimator: str | None = None,
        pitch: float | tuple[float, float] | None = None,
        accuracy: float | None = None,
        calibration: Calibration | str | Path | None = None,
        timeout: float = 3.0,
        delivery: Delivery | None = None,
        queue: int = QUEUE,
        reconnect: float = 10.0,
    ) -> Opening:
        """Read the files and check the numbers of :class:`SkinSettings`; InputError.

        The settings of the ``recording`` that is played (its name; empty: a live board) hold where none are given.
        """
        timeout_s, queued = positive("timeout", timeout, "s"), count("queue", queue)
        reconnect_s = number("reconnect", reconnect, "s")
        if not reconnect_s >= 0:
            raise InputError(f"reconnect is {reconnect} s; expected at least 0")
        if estimator is not None and estimator not in ESTIMATORS:
            raise InputError(f"no estimator '{estimator}'; expected one of {', '.join(ESTIMATORS)}")
        ValidityRule.of(accuracy)
        family = recorded.family(recording) if recording and board == NATIVE else board_family(board)
        design = recorded.design if design is None else design
        design = family.files.get("design") if design is None else design
        cell = recorded.cell if cell is None else cell
        cell = family.files.get("cell") if cell is None else cell
        calibration = recorded.calibration if calibration is None else calibration
        settings = RecordedSettings(
            family.name,
            None if design is None else loaded("design", design, Design),
            None if cell is None else loaded("cell", cell, Cell),
            recorded.estimator if estimator is None else estimator,
            recorded.pitch if pitch is None else Pitch.of(pitch),
            recorded.accuracy if accuracy is None else accuracy,
            None if calibration is None else loaded("calibration", calibration, Calibration),
            family.tables if family.design is None else None,
            recorded.introduction,
        )
        if settings.design is None and family.design is None and not family.has_description:
            given = [name for name in ("cell", "calibration") if getattr(settings, name) is not None]
            if given:
                raise InputError(
                    f"a {given[0]} for board '{family.name}', whose circuit is not known; expected a design, too "
                    "(--design DESIGN.toml, or design = in BOARD.toml)"
                )
        if delivery is None:
            delivery = "lossless" if recording else "newest"
        if delivery not in ("newest", "every", "lossless"):
            raise InputError(f"delivery '{delivery}'; expected newest, every or lossless")
        if serial_number is not None:
            of_kind("serial_number", serial_number, str, "text")
        return cls(family, settings, timeout_s, delivery, queued, reconnect_s, serial_number)


class Link:
    """A board at an open port: the reader thread, and the objects that it shares with the consumers of frames."""

    def __init__(self, port: BytePort, opening: Opening, reopen: Callable[[], BytePort] | None) -> None:
        self._port, self._opening = port, opening
        settings, delivery = opening.settings, opening.delivery
        self.counters = Counters()
        self.mailbox = Mailbox(opening.queue, drops_oldest=delivery != "lossless")
        self.introduction = Introduction(opening.family, port.name, settings.design, settings.cell)
        known = settings.calibration
        calibrated = known is not None and bool(known.serial_number)
        self.introduction.must_identify = calibrated or bool(opening.serial_number)
        self.reader = Reader(
            port,
            protocol=self._host_end,
            introduction=self.introduction,
            mailbox=self.mailbox,
            counters=self.counters,
            lossless=delivery == "lossless",
            reopen=reopen,
            reconnect_s=opening.reconnect_s,
        )
        self.reader.introduce_before(settings.introduction)

    def record(self, path: str | Path, *, overwrite: bool) -> Recording:
        """Record from the first byte on; before :meth:`introduce`. Raises InputError."""
        recording = Recording(path, self._opening.settings.as_metadata(), overwrite=overwrite)
        self.reader.taps.append(recording.arrived)
        self.reader.on_gone.append(recording.port_gone)
        return recording

    def introduce(self) -> Converter:
        """Start reading, wait until the board has identified itself, and set up the converter of its frames.

        Raises:
            LinkTimeout, ProtocolError, LinkError, InputError: as :meth:`Skin.__init__`. The reader thread goes on.

        """
        limit_s = self._opening.timeout_s
        self.reader.start()
        self.reader.await_introduction(limit_s)
        converter = _within(limit_s, self._set_up)
        if converter is None:
            raise ProtocolError(
                f"{self._port.name}: the inverse of the board's circuit was not set up within {limit_s:g} s; "
                "give a longer timeout, if the board's description is right"
            )
        if self._opening.delivery != "lossless":
            self.reader.keep_up = converter.keep_up
        return converter

    def _host_end(self) -> HostProtocol:
        """A new host protocol, with the array's size if the board does not send it."""
        family = self._opening.family
        if family.has_description:
            return host_protocol(family)
        design = self.introduction.design()
        if isinstance(design, Layout):
            return host_protocol(family)
        adc_bits = None if design.adc is None else design.adc.bits
        return host_protocol(family, shape=design.array.shape, adc_bits=adc_bits)

    def _set_up(self) -> Converter:
        """The converter for the board, after a trial conversion."""
        introduction, settings = self.introduction, self._opening.settings
        design, cell = introduction.design(), introduction.cell()
        if settings.calibration is not None and isinstance(design, Design):
            try:
                settings.calibration.check_board(design, cell, introduction.serial_number)
            except InputError as error:
                raise InputError(f"{self._port.name}: {error}") from None
        try:
            converter = Converter(
                design,
                cell,
                settings.estimator,
                Pitch.of(design.sheet.pitch if isinstance(design, Design) else Sheet().pitch)
                if settings.pitch is None
                else settings.pitch,
                self.mailbox,
                self.counters,
                newest_only=self._opening.delivery == "newest",
                rest_changes=self._port.rest_changes if isinstance(self._port, ReplayPort) else (),
                accuracy=settings.accuracy,
                calibration=settings.calibration,
            )
            converter.try_out()
        except OhmskinError:
            raise
        except (ArithmeticError, LookupError, ValueError, TypeError, MemoryError, RecursionError) as error:
            # The design and the cell pass their own checks, but nothing can be computed from them.
            raise introduction.refused(error) from error
        return converter


_ROOM = threading.BoundedSemaphore(MOST_ABANDONED)
"""for set-ups that were given up, and that may still be at work"""


def _within(limit_s: float, work: Callable[[], Converter]) -> Converter | None:
    """The result of ``work``; None after ``limit_s`` of processor time, and the work then ends by itself.

    The limit is for descriptions from which nothing can be computed. Two delays are not the description's fault: the
    compiler, for which the first skin on a machine waits, and other programs that use the processor. The compiler's
    time does not count. Of the real time, at least a share of 1 / :data:`PATIENCE` counts.

    Nothing ends a thread from outside. While :data:`MOST_ABANDONED` works that were given up go on, another one waits
    for one of them, within ``limit_s``.
    """
    if not _ROOM.acquire(timeout=min(limit_s, threading.TIMEOUT_MAX)):
        return None
    _ROOM.release()
    future: Future[Converter] = Future()
    clocks: list[int] = []

    def run() -> None:
        try:
            if sys.platform == "linux":
                clocks.append(time.pthread_getcpuclockid(threading.get_ident()))
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="ohmskin set-up", daemon=True).start()
    left_s, processor_s = limit_s, 0.0
    while left_s > 0:
        before_s, processor_before_s = time.monotonic(), processor_s
        wait([future], min(left_s, POLL_S))
        if future.done():
            return future.result()
        elapsed_s = time.monotonic() - before_s
        processor_s = _processor_s(clocks, processor_before_s + elapsed_s)
        if not is_compiling():
            left_s -= max(processor_s - processor_before_s, elapsed_s / PATIENCE)
    if _ROOM.acquire(blocking=False):
        future.add_done_callback(lambda _: _ROOM.release())
    return None


def _processor_s(clocks: list[int], otherwise_s: float) -> float:
    """Processor time in s of a thread by its clock; ``otherwise_s`` if it has none, or the thread has ended."""
    try:
        return time.clock_gettime(clocks[0]) if clocks else otherwise_s
    except OSError:
        return otherwise_s
