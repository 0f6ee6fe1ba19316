"""From an open port to frames: the connection, the board's handshake, and the inverse of its circuit."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait

from ..circuits import Design, Shape, Sheet
from ..common.compiled import is_compiling
from ..common.geometry import Geometry
from ..errors import InputError, OhmskinError, ProtocolError
from ..wire import HostProtocol, Layout, host_protocol
from ._connection import Connection
from ._convert import Converter
from ._frames import Frames
from ._handshake import Handshake
from ._options import Options
from ._port import BytePort
from ._replay import ReplayPort
from ._statistics import Counters
from ._tare import RestChange
from ._tuning import MOST_ABANDONED, PATIENCE, POLL_S


def connect(port: BytePort, options: Options, reopen: Callable[[], BytePort] | None) -> Connection:
    """The connection to the board behind an open port, which reads nothing yet."""
    settings = options.settings
    handshake = Handshake(options.family, port.name, settings.design, settings.cell)
    known = settings.calibration
    calibrated = known is not None and bool(known.serial_number)
    handshake.must_identify = calibrated or bool(options.serial_number)

    def host_end() -> HostProtocol:
        """A new host protocol, with the array's size if the board does not send it."""
        design = options.family.layout if options.family.has_description else handshake.design()
        if isinstance(design, Layout):
            return host_protocol(options.family)
        adc_bits = None if design.adc is None else design.adc.bits
        return host_protocol(options.family, shape=design.array.shape, adc_bits=adc_bits)

    connection = Connection(
        port,
        protocol=host_end,
        handshake=handshake,
        frames=Frames(options.delivery, options.queue, Counters()),
        reopen=reopen,
        reconnect_s=options.reconnect_s,
    )
    connection.hear_before(settings.introduction)
    return connection


def begin(connection: Connection, port: BytePort, options: Options) -> None:
    """Start reading, wait until the board has identified itself, and set up the converter of its frames.

    Raises:
        LinkTimeout, ProtocolError, LinkError, InputError: as :meth:`Skin.__init__`. The reader thread goes on.

    """
    connection.start()
    connection.await_handshake(options.timeout_s)
    rest_changes = port.rest_changes if isinstance(port, ReplayPort) else ()
    converter = _within(options.timeout_s, lambda: _converter(connection, rest_changes, options))
    if converter is None:
        raise ProtocolError(
            f"{port.name}: the inverse of the board's circuit was not set up within {options.timeout_s:g} s; "
            "give a longer timeout, if the board's description is right"
        )
    connection.frames.converter = converter


def _converter(connection: Connection, rest_changes: Sequence[RestChange], options: Options) -> Converter:
    """The converter for the board, after a trial conversion."""
    handshake, settings = connection.handshake, options.settings
    design, cell = handshake.design(), handshake.cell()
    if settings.calibration is not None and isinstance(design, Design):
        try:
            settings.calibration.check_board(design, cell, handshake.serial_number)
        except InputError as error:
            raise InputError(f"{connection.port_name}: {error}") from None
    try:
        converter = Converter(
            design,
            cell,
            settings.estimator,
            geometry_of(design, settings.shape, settings.pitch),
            connection.frames.counters,
            rest_changes=rest_changes,
            accuracy=settings.accuracy,
            calibration=settings.calibration,
        )
        converter.try_out()
    except OhmskinError:
        raise
    except (ArithmeticError, LookupError, ValueError, TypeError, MemoryError, RecursionError) as error:
        # The design and the cell pass their own checks, but nothing can be computed from them.
        raise handshake.refused(error) from error
    return converter


def geometry_of(design: Design | Layout, shape: Shape | None, pitch_m: tuple[float, float] | None) -> Geometry:
    """Where the cells are: as given by a shape or a pitch, else as the design says.

    Raises:
        InputError: a cell of the shape lies outside the array, or there is a pitch beside a shape.

    """
    array = design.array.shape if isinstance(design, Design) else (design.rows, design.columns)
    if shape is not None:
        return shape.geometry(array)
    own = design.shape if isinstance(design, Design) else None
    if pitch_m is not None:
        if own is not None:
            raise InputError(f"pitch is {pitch_m} m, but [shape] of the design says where the cells are; leave one out")
        return Geometry.rectangle(array, pitch_m)
    return design.geometry if isinstance(design, Design) else Geometry.rectangle(array, (Sheet().pitch,) * 2)


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
