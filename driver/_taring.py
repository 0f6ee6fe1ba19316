"""Tares of an open skin: taken from its next frames, used, and undone."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..circuits import Reason
from ..errors import InputError
from ._calibration import Calibration
from ._consumer import Consumer
from ._frame import Frame
from ._frames import Frames
from ._tare import EarlierRest, RestReadings, Tare


class Tares:
    """The tares that a skin has used since it was opened; the last one is in use. Safe for threads."""

    def __init__(self, frames: Frames, consumer: Consumer, calibration: Calibration | None) -> None:
        """Begin without a tare.

        Args:
            frames: converts with the rest resistances.
            consumer: the place of the skin's own reader in the stream.
            calibration: rest resistances from before any tare.

        """
        self._frames, self._converter = frames, frames.converter
        self._consumer, self._calibration = consumer, calibration
        self._used: list[Tare | None] = [None]
        self._lock = threading.Lock()

    @property
    def in_use(self) -> Tare | None:
        """The tare in use; None: rest resistances are those from before any tare."""
        return self._used[-1]

    def take(
        self,
        frames: int,
        timeout_s: float,
        *,
        serial_number: Callable[[], str],
        board: str,
        drift: float,
        spread: float,
        force: bool,
    ) -> Tare:
        """Make a tare of the next frames, and use it; arguments and errors as for :meth:`.Skin.tare`.

        Args:
            frames: to average.
            timeout_s: for each frame.
            serial_number: returns that of the board once the frames have come; empty if the board sends none.
            board: name of the board in messages.
            drift: relative change since the tare or calibration in use that is no sign of a load.
            spread: relative deviation of a cell from the others that is no sign of a load.
            force: use the tare in spite of signs of a load.

        """
        with self._lock:
            taken, numbers = self._next_frames(frames, timeout_s)
            self._converter.contacts.catch_up()
            tare = self._made_of(taken, serial_number(), drift=drift, spread=spread)
            # Of a hole nothing is left to be measured.
            tare = replace(tare, measured=tare.measured | ~self._converter.geometry.exists)
            if tare.remarks and tare.frames_advised and not force:
                raise InputError(
                    f"{board}: no tare, though noise may be why {tare.remarks[0]}. "
                    f"Take more frames, tare({tare.frames_advised}), or tare(force=True)"
                )
            if tare.remarks and not force:
                unlike = ""
                if tare.spread_advised:
                    unlike = f"; tare(spread={tare.spread_advised:g}) if nothing is on it, and its cells differ so"
                raise InputError(
                    f"{board}: no tare, the skin seems to be loaded: {'; '.join(tare.remarks)}. "
                    f"Take everything off it{unlike}, or tare(force=True)"
                )
            self._used.append(tare)
            self._apply(numbers)
        if tare.frames_advised and not tare.remarks:
            warnings.warn(f"{board}: a tare with {tare.covers}", RuntimeWarning, stacklevel=3)
        return tare

    def use(self, tare: Tare | None, *, serial_number: str) -> None:
        """Use an earlier tare; arguments and errors as for :meth:`.Skin.use_tare`."""
        shape = self._converter.shape
        if tare is not None:
            if tare.rest_resistance_ohm.shape != shape:
                rows, columns = tare.rest_resistance_ohm.shape
                raise InputError(f"a tare of {rows} x {columns} cells; this skin has {shape[0]} x {shape[1]}")
            if (tare.rest_counts is None) != (self._converter.design is not None):
                of, here = ("counts", "known") if tare.rest_counts is not None else ("resistances", "not known")
                raise InputError(f"a tare of {of}; the circuit of this board is {here}")
            if tare.serial_number and serial_number and tare.serial_number != serial_number:
                raise InputError(f"a tare of board {tare.serial_number}; this is board {serial_number}")
        with self._lock:
            self._used.append(tare)
            self._apply()

    def undo(self) -> Tare | None:
        """Return to the previous tare. Returns the tare then in use, None for none."""
        with self._lock:
            if len(self._used) > 1:
                self._used.pop()
            self._apply()
            return self.in_use

    def disown(self) -> None:
        """In a forked process: replace the lock, since a tare that another thread was taking does not end here."""
        self._lock = threading.Lock()

    def _apply(self, tared: Sequence[int] = ()) -> None:
        tare = self.in_use
        self._frames.use_rest(None if tare is None else tare.rest)
        self._consumer.forget(tared)

    def _next_frames(self, frames: int, timeout_s: float) -> tuple[list[Frame], list[int]]:
        """The next frames and their numbers; other readers get them, too."""
        consumer = self._consumer.for_tare()
        taken: list[Frame] = []
        numbers: list[int] = []
        try:
            while len(taken) < frames:
                taken.append(consumer.next_frame(timeout_s))
                numbers.append(consumer.index)
        finally:
            consumer.leave()
        return taken, numbers

    def _made_of(self, taken: list[Frame], serial_number: str, *, drift: float, spread: float) -> Tare:
        # Losses before the first of these frames, perhaps long ago, do not belong to the tare.
        losses = [frame.lost_before for frame in taken[1:]]
        lost = None if None in losses else sum(loss or 0 for loss in losses)
        known: dict[str, Any] = {"lost": lost, "serial_number": serial_number, "wall_time": taken[-1].host_time}
        times_s = np.array([frame.monotonic_time for frame in taken])
        if self._converter.design is None:
            counts = np.array([np.where(frame.valid, frame.counts, np.nan) for frame in taken])
            return RestReadings(counts, times_s).tare_of_counts(**known)
        noisy, silent = (
            2 * np.count_nonzero([frame.reason == why for frame in taken], axis=0) > len(taken)
            for why in (Reason.UNCERTAIN, Reason.NO_CURRENT)
        )
        readings = RestReadings(np.where(silent, np.nan, [frame.resistance for frame in taken]), times_s, noisy, silent)
        return readings.tare(
            self._converter.cell,
            **known,
            calibrated_ohm=None if self._calibration is None else self._calibration.rest_ohm,
            earlier=self._earlier_rest(),
            drift=drift,
            spread=spread,
        )

    def _earlier_rest(self) -> EarlierRest | None:
        """The rest resistances in use, if they are those of an unloaded skin."""
        tare, known = self.in_use, self._calibration
        if tare is not None:
            if tare.remarks:
                return None
            then = f"{tare.taken_at:%Y-%m-%d %H:%M} UTC"
            return EarlierRest(f"the tare of {then}", tare.rest_resistance_ohm, tare.measured)
        if known is None:
            return None
        return EarlierRest(f"the calibration of {known.date}", known.rest_ohm, np.ones(known.shape, dtype=bool))
