"""``Skin``: the driver's main class. It turns the bytes of one board, or of several, into frames of a skin."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Unpack, cast

import numpy as np

from ..circuits import Design
from ..common import compiled
from ..common.checks import path_text, positive
from ..common.files import of_board
from ..common.geometry import Geometry
from ..common.progress import Progress, silent
from ..errors import InputError, LinkEnded, LinkError
from ..wire import Order
from ._connection import await_free
from ._consumer import Consumer
from ._contacts import Touch
from ._discover import find_board
from ._frames import Delivery
from ._joined import JoinedBoards, JoinedFrames, Joiner, total, widened
from ._options import Options, SkinSettings
from ._orders import Answer
from ._port import Arrival, BytePort
from ._port_names import EMULATED_HERE, has_gone, is_unpaced, refuse_missing
from ._reconnect import PortFinder
from ._recording import Recording
from ._replay import RecordedSettings, ReplayPort
from ._skin import BoardSkin
from ._statistics import LinkStatistics
from ._tare import Tare
from ._tuning import ANSWER_S, KNOWN_DRIFT, QUEUE, SPREAD


class Skin(BoardSkin):
    """An open skin: iterate over it for its frames. Make one with :meth:`open`."""

    @classmethod
    def open(
        cls,
        port: str | Path | Sequence[str | Path] | None = None,
        *,
        serial_number: str | None = None,
        baudrate: int | None = None,
        record: str | Path | None = None,
        overwrite: bool = False,
        speed: float | None = None,
        progress: Progress = silent,
        **settings: Unpack[SkinSettings],
    ) -> Skin:
        """Open a serial device, a pty, ``socket://HOST:PORT`` or a recording (a file that ends in ``.mcap``).

        A recording supplies every setting of its skin that is not given here.

        Args:
            port: name of the port; None: the port where :func:`discover` finds the board ``serial_number``. A list of
                ports, or of recordings: their boards are one skin (:class:`JoinedSkin`). A setting may then be a list,
                too, with a value for each board.
            serial_number: that the board must have.
            baudrate: of the UART, where there is one; None: that of the family.
            record: MCAP file to record to, from the first byte; the recording ends with the skin.
            overwrite: replace a recording that is there already.
            speed: replay speed of a recording, relative to real time; None: as fast as the file is read. A live board
                sets its own pace.
            progress: called with the bytes of a recording that were looked through, and with all of them, before it
                plays.
            settings: board, design, cell, delivery and more, see :class:`SkinSettings`.

        Raises:
            LinkError: the port does not exist, may not be used, or is in use, or another board is behind it.
            InputError: ``speed`` is given and ``port`` is no recording; or boards do not fit together.
            Also everything that :meth:`__init__` raises.

        """
        if isinstance(port, list | tuple):
            given: dict[str, Any] = dict(settings, serial_number=serial_number, baudrate=baudrate, speed=speed)
            return _open_joined(port, record, overwrite=overwrite, progress=progress, **given)
        opened: BytePort
        reopen: Callable[[], BytePort]
        one = cast("str | Path | None", port)  # anything else is refused here
        name = None if one is None else path_text("port", one, "the name of a port or of a recording")
        played = ReplayPort(name, speed, progress) if name is not None and name.endswith(".mcap") else None
        # All errors in the arguments are reported before anybody waits for a board or for the compiler.
        if played is not None:
            asked = Options.of(recorded=played.settings, recording=played.name, serial_number=serial_number, **settings)
        elif speed is not None:
            raise InputError(f"speed is {speed}, but only a recording (a file that ends in .mcap) has one")
        else:
            if name is not None and is_unpaced(name) and settings.get("delivery") is None:
                settings["delivery"] = "lossless"
            asked = Options.of(serial_number=serial_number, **settings)
        if record is not None:
            Recording.check(record, overwrite=overwrite)
        finder = _finder(name, asked, baudrate) if played is None else None
        began_s = monotonic()
        # A board in this process starts when it is opened, and would fall behind while its cells are plain Python.
        starts_here = name is not None and name.startswith(EMULATED_HERE)
        compiles_aside = not starts_here and compiled.compile_aside()
        if finder is not None:
            if not compiles_aside:
                compiled.load()  # while no frames come
            if has_gone(finder.name):
                raise LinkError(
                    f"{finder.name}: the port has gone in the {monotonic() - began_s:.0f} s in which machine code was "
                    "prepared, which is kept for the next time. Plug the board in, or start the emulation, again"
                )
            opened, reopen = finder.open(), finder.open_again
        else:
            assert played is not None
            opened, reopen = played, played.reopen
        skin = cls.__new__(cls)
        skin._begin(opened, asked, reopen, record, overwrite=overwrite)
        if finder is not None:
            handshake = skin._connection.handshake
            finder.board_is_numbered = lambda: bool(handshake.serial_number)
            skin._must_be(serial_number)
        return skin


def _finder(port: str | None, asked: Options, baudrate: int | None) -> PortFinder:
    """Finder of the board's port, by name or by serial number; errors as for :meth:`Skin.open`."""
    family = asked.family
    if baudrate is not None:
        positive("baudrate", baudrate, "bit/s")
    if port is None:
        if asked.serial_number is None:
            raise InputError("neither a port nor a serial number; expected one of them")
        port = find_board(asked.serial_number, board=family, timeout=min(asked.timeout_s, ANSWER_S))
    refuse_missing(port)  # before the wait for the compiler
    await_free(port)
    return PortFinder(port, baudrate=baudrate or family.baud_rate, dtr=family.dtr, rts=family.rts)


def _open_joined(
    ports: Sequence[str | Path], record: str | Path | None, *, overwrite: bool, progress: Progress, **settings: Any
) -> JoinedSkin:
    """The boards behind several ports, or their recordings, as one skin; errors as :meth:`.Skin.open`.

    A setting that is a list has a value for each board. A recording ``skin.mcap`` becomes one file for each board:
    ``skin-1.mcap``, ``skin-2.mcap`` and so on.
    """
    if not ports:
        raise InputError("no ports; expected at least one")
    recorded = [str(port).endswith(".mcap") for port in ports]
    if any(recorded) and not all(recorded):
        raise InputError("recordings and ports of boards in one skin; expected one or the other")
    if settings.get("delivery") == "lossless":
        raise InputError("delivery is lossless; expected newest or every, as several boards do not wait for each other")
    for name, value in settings.items():
        if isinstance(value, list) and len(value) != len(ports):
            raise InputError(f"{name} has {len(value)} values; expected one for each of {len(ports)} boards")
    own = [
        {name: value[k] if isinstance(value, list) else value for name, value in settings.items()}
        for k in range(len(ports))
    ]
    files = [None if record is None else of_board(record, k) for k in range(len(ports))]
    boards: list[Skin] = []
    try:
        for port, each, file in zip(ports, own, files, strict=True):
            boards.append(Skin.open(port, record=file, overwrite=overwrite, progress=progress, **each))
        return JoinedSkin(boards, delivery=settings.get("delivery"), queue=settings.get("queue", QUEUE))
    except BaseException:
        _close(boards)
        raise


class JoinedSkin(Skin):
    """Several boards as one skin: the methods of :class:`.Skin`, and :attr:`boards` for what each board alone has.

    Made by ``Skin.open([...])``.
    """

    def __init__(self, boards: Sequence[Skin], *, delivery: Delivery | None = None, queue: int = QUEUE) -> None:
        """Join open skins, which belong to this one from then on.

        Raises:
            InputError: some have a shape and others none, or cells of two boards are at one place.

        """
        self._boards = tuple(boards)
        limits = [board.touch for board in boards]
        touch = Touch(
            max(one.full_scale_kpa for one in limits),
            max(one.drift_kpa for one in limits),
            any(one.faults_press for one in limits),
        )
        joiner = Joiner([board.geometry for board in boards], touch)
        self._geometry = joiner.geometry
        self._timeout = max(board._timeout for board in boards)
        self.family, self.cell, self.calibration = boards[0].family, boards[0].cell, None
        played = [board.recorded_s for board in boards]
        self.recorded_s = None if None in played else max(seconds or 0.0 for seconds in played)
        if self.recorded_s is not None:
            delivery = "lossless"
        frames = JoinedFrames(joiner, boards, "newest" if delivery is None else delivery, queue)
        self._frames, self._source = frames, JoinedBoards(boards, frames, joiner)
        self._consumer, self._callbacks = Consumer(self._source, after=0), []
        weakref.finalize(self, _close, self._boards).atexit = False
        if self.recorded_s is not None:
            frames.play()
        else:
            for k, board in enumerate(boards):
                board.on_frame(partial(frames.arrive, k), partial(frames.part_ended, k))

    def _refused(self, what: str) -> InputError:
        return InputError(f"{what} belongs to one board; ask one of the {len(self.boards)} in boards")

    @property
    def boards(self) -> tuple[Skin, ...]:
        """The skin of each board."""
        return self._boards

    # -- what is known -------------------------------------------------------------------------------------------------

    @property
    def serial_number(self) -> str:
        """Serial numbers of the boards; empty if none sends one."""
        return " + ".join(filter(None, (board.serial_number for board in self.boards)))

    @property
    def identity(self) -> None:
        """Each board has its own."""
        return None

    @property
    def description(self) -> None:
        """Each board has its own."""
        return None

    @property
    def knows_circuit(self) -> bool:
        """Whether those of all boards are known."""
        return all(board.knows_circuit for board in self.boards)

    @property
    def design(self) -> Design:
        """InputError: each board has its own."""
        raise self._refused("a design")

    @property
    def circuit_name(self) -> str | None:
        """Of the readouts; None where one is not known."""
        names = [board.circuit_name for board in self.boards]
        return None if None in names else ", ".join(dict.fromkeys(filter(None, names)))

    @property
    def count_bits(self) -> int:
        """The most bits of a count."""
        return max(board.count_bits for board in self.boards)

    @property
    def full_scale_kpa(self) -> float | None:
        """The largest; None: not known of all."""
        known = [board.full_scale_kpa for board in self.boards]
        return None if None in known else max(kpa or 0.0 for kpa in known)

    @property
    def touch(self) -> Touch:
        """InputError: each board has its own."""
        raise self._refused("what tells contacts")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows of all boards, and the most columns of one."""
        return self._geometry.shape

    @property
    def geometry(self) -> Geometry:
        """Places of all cells."""
        return self._geometry

    @property
    def estimator_name(self) -> str:
        """Names of the estimators."""
        return ", ".join(dict.fromkeys(filter(None, (board.estimator_name for board in self.boards))))

    def __repr__(self) -> str:
        rows, columns = self.shape
        return f"<JoinedSkin of {len(self.boards)} boards: {rows} x {columns}; {', '.join(map(repr, self.boards))}>"

    def stats(self) -> LinkStatistics:
        """Sums over the boards; of ages and jitter the largest, and the rate of the fastest board."""
        each = [board.stats() for board in self.boards]
        return LinkStatistics(
            **{item.name: _together([getattr(one, item.name) for one in each]) for item in fields(each[0])}
        )

    # -- orders, recordings --------------------------------------------------------------------------------------------

    def on_bytes(self, tap: Callable[[Arrival], None]) -> None:
        """InputError: each board has its own."""
        raise self._refused("a stream of bytes")

    def close(self) -> None:
        """Release all ports, as :meth:`.Skin.close`."""
        for callback in self._callbacks:
            callback.end()
        errors = _close(self.boards)
        self._frames.close(LinkEnded(f"{self.port_name}: the skin is closed"))
        for callback in self._callbacks:
            callback.close()
        if errors:
            raise errors[0]

    def request(self, order: Order, *, period_us: int = 0, timeout: float | None = None) -> Answer | None:
        """InputError: ask one of the boards."""
        raise self._refused("an order")

    def settings_to_join(self) -> RecordedSettings:
        """InputError: record each of the boards."""
        raise self._refused("a recording")

    def attach(self, recording: Recording) -> None:
        """InputError: record each of the boards."""
        raise self._refused("a recording")

    @property
    def recorder(self) -> Recording | None:
        """The recording of the first board."""
        return self.boards[0].recorder

    # -- rest ----------------------------------------------------------------------------------------------------------

    def tare(
        self, frames: int = 20, *, force: bool = False, drift: float = KNOWN_DRIFT, spread: float = SPREAD
    ) -> Tare:
        """Tare all boards at once, or none, as :meth:`.Skin.tare`."""
        with ThreadPoolExecutor(len(self.boards)) as pool:
            made = [pool.submit(board.tare, frames, force=force, drift=drift, spread=spread) for board in self.boards]
        failed = [error for one in made if (error := one.exception()) is not None]
        if failed:
            for board, one in zip(self.boards, made, strict=True):
                if one.exception() is None:
                    board.undo_tare()
            raise failed[0]
        self._consumer.forget()
        return self._as_one([one.result() for one in made])

    @property
    def tared(self) -> Tare | None:
        """The tares in use as one; None: not all boards have one."""
        found = [tare for board in self.boards if (tare := board.tared) is not None]
        return self._as_one(found) if len(found) == len(self.boards) else None

    def use_tare(self, tare: Tare | str | Path | None) -> None:
        """InputError, but for None: each board has its own."""
        if tare is not None:
            raise self._refused("a saved tare")
        for board in self.boards:
            board.use_tare(None)

    def undo_tare(self) -> Tare | None:
        """Return to the tares before. Returns those then in use."""
        for board in self.boards:
            board.undo_tare()
        return self.tared

    def _as_one(self, tares: Sequence[Tare]) -> Tare:
        across = self.shape[1]

        def cells(name: str, none: float) -> Any:
            return np.concatenate([widened(getattr(tare, name), across, none) for tare in tares])

        only_counts = all(tare.rest_counts is not None for tare in tares)
        return Tare(
            rest_resistance_ohm=cells("rest_resistance_ohm", np.nan),
            measured=cells("measured", True),
            std_ohm=cells("std_ohm", np.nan),
            frames=min(tare.frames for tare in tares),
            lost=total([tare.lost for tare in tares]),
            serial_number=self.serial_number,
            wall_time=max(tare.wall_time for tare in tares),
            remarks=tuple(remark for tare in tares for remark in tare.remarks),
            rest_counts=cells("rest_counts", np.nan) if only_counts else None,
        )


def _close(boards: Sequence[Skin]) -> list[InputError]:
    """Close all; the errors of recordings that could not be written to their ends."""
    errors = []
    for board in boards:
        try:
            board.close()
        except InputError as error:
            errors.append(error)
    return errors


def _together(values: Sequence[Any]) -> Any:
    """One value of the statistics for those of several boards."""
    match values[0]:
        case dict():
            names = dict.fromkeys(name for value in values for name in value)
            of = max if any(isinstance(name, int) for name in names) else sum
            return {name: of([value.get(name, 0) for value in values]) for name in names}
        case float():
            return max(values)
        case int() if None not in values:
            return sum(values)
        case str():
            return "; ".join(filter(None, values))
    texts = [value for value in values if isinstance(value, str)]
    return "; ".join(texts) or None
