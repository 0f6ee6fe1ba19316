"""Tare: each cell's resistance at rest, measured on the unloaded skin, with a test whether the skin was unloaded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..cell import Cell, ContactModel
from ..common.archives import Stored, read_arrays
from ..common.arrays import BoolArray, FloatArray, scatter
from ..common.config import LEAST_SI, MOST_SI
from ..common.files import whole_file
from ..common.text import count_of, printable
from ..errors import InputError
from ._tuning import (
    CONTACT_LOAD,
    DRIFT,
    DRIFT_COUNTS,
    ENOUGH_READINGS,
    KNOWN_DRIFT,
    NOISE_SHARE,
    OUTLYING_STDS,
    SHEET_FACTOR,
    SPREAD,
    SURE_STDS,
    TYPICAL_READINGS,
)

MOST_BYTES = 2**26
"""size limit of a file: a tare of 1024 x 1024 cells fits"""
LATEST_S = 4e9
"""s since the epoch, in the year 2096: no tare is later"""
MOST_FRAMES = 2**31
"""of a tare: a year at 60 Hz"""
MOST_COUNT = 2.0**16
_CELLS = ("rows", "columns")
_STORED = {
    "rest_resistance_ohm": Stored("numbers", _CELLS, LEAST_SI, MOST_SI, nan=True),  # NaN: the circuit is not known
    "measured": Stored("flags", _CELLS),
    "std_ohm": Stored("numbers", _CELLS, 0.0, MOST_SI, nan=True),
    "frames": Stored("whole numbers", least=1, most=MOST_FRAMES),
    "lost": Stored("whole numbers", least=-1, most=MOST_FRAMES),  # -1: not known
    "serial_number": Stored("text"),
    "wall_time": Stored("numbers", least=0.0, most=LATEST_S),
    "remarks": Stored("text", ("remarks",)),
    "rest_counts": Stored("numbers", _CELLS, 0.0, MOST_COUNT, optional=True),
}
"""arrays of a file, and what they may be"""


class RestChange(NamedTuple):
    """Other rest resistances from one frame of a recording on."""

    after_frame: int
    """number of the last frame before them; 0: they hold from the beginning"""
    rest: FloatArray | None
    """(cells,) ohm, or counts where the circuit is not known; None: those of the data sheet"""


@dataclass(frozen=True, slots=True, eq=False)
class Tare:
    """Rest resistances of a skin's cells. Arrays are (rows, columns)."""

    rest_resistance_ohm: FloatArray
    """mean over the frames; where not measured, the calibration's value in proportion to the other cells, else the data
    sheet's value, else the median of the others"""
    measured: BoolArray
    """False for a cell without a valid reading; True for one that reads no current, where cells are open at rest"""
    std_ohm: FloatArray
    """standard deviation from frame to frame; NaN where not measured"""
    frames: int
    """frames that were averaged"""
    lost: int | None
    """frames lost meanwhile; None if the board does not number its frames"""
    serial_number: str
    """of the board; empty if the board does not send one"""
    wall_time: float
    """arrival of the last frame in s since the epoch"""
    remarks: tuple[str, ...] = ()
    """signs that the skin was loaded; a tare with remarks was forced"""
    frames_advised: int = 0
    """sufficient number of frames, if noise alone may cause these signs, or leave cells without a reading; else 0"""
    spread_advised: float = 0.0
    """relative deviation of the cells from each other that would explain these signs, if the cells scatter so widely
    that manufacturing tolerances may be the cause, and no other sign points to a load; else 0"""
    rest_counts: FloatArray | None = None
    """mean counts at rest of a board whose circuit is not known: then no resistance is known, and those here are NaN"""

    @property
    def rest(self) -> FloatArray:
        """What the frames after the tare are compared with: resistances in ohm, or counts."""
        return self.rest_resistance_ohm if self.rest_counts is None else self.rest_counts

    @property
    def covers(self) -> str:
        """How many cells have been measured, and how many frames would measure the cells that noise hides."""
        covered = f"{int(self.measured.sum())} of {count_of(self.measured.size, 'cell')} measured{self._lines_left_out}"
        if self.remarks or not self.frames_advised:
            return covered
        return f"{covered}, noise hides the others; tare({self.frames_advised}) covers nearly all"

    @property
    def _lines_left_out(self) -> str:
        """The lines of which no cell was measured, if others were and noise is not the cause."""
        lines = [
            f"{kind} {number}"
            for kind, axis in (("row", 1), ("column", 0))
            for number in np.flatnonzero(~self.measured.any(axis=axis))
        ]
        return f", without {', '.join(lines)}" if lines and self.measured.any() and not self.frames_advised else ""

    @property
    def taken_at(self) -> datetime:
        """Arrival time of the last frame, UTC."""
        return datetime.fromtimestamp(self.wall_time, UTC)

    def __repr__(self) -> str:
        """Size, typical resistance, date and board in one line, without the arrays."""
        rows, columns = self.rest_resistance_ohm.shape
        known, unit = self.rest[self.measured], "ohm" if self.rest_counts is None else "counts"
        typical = f", typically {np.median(known):.6g} {unit}" if known.size else ""
        board = f"; board {printable(self.serial_number)}" if self.serial_number else ""
        forced = f"; {count_of(len(self.remarks), 'remark')}" if self.remarks else ""
        return (
            f"<Tare of {rows} x {columns} cells over {count_of(self.frames, 'frame')}{typical}: {self.covers}; "
            f"{self.taken_at:%Y-%m-%d %H:%M} UTC{board}{forced}>"
        )

    def save(self, path: str | Path) -> None:
        """Write the tare to a NumPy archive (.npz); InputError if that fails."""
        values = {key: np.asarray(value) for key in _STORED if (value := getattr(self, key)) is not None}
        values["lost"] = np.asarray(-1 if self.lost is None else self.lost)
        values["remarks"] = np.asarray(self.remarks, dtype=np.str_)
        with whole_file(path) as file:
            np.savez(file, allow_pickle=False, **values)

    @classmethod
    def load(cls, path: str | Path) -> Tare:
        """Read a file of :meth:`save`.

        Raises:
            InputError: the file cannot be read or is no saved tare.

        """
        values = read_arrays(path, _STORED, what="saved tare", most_bytes=MOST_BYTES)
        rest, counts, measured = (values.get(key) for key in ("rest_resistance_ohm", "rest_counts", "measured"))
        if rest is None or measured is None or rest.size == 0 or (counts is None and np.isnan(rest).any()):
            raise InputError(f"{path}: is no saved tare: rest resistances must be numbers (rows, columns)")
        lost = int(values["lost"])
        return cls(
            rest_resistance_ohm=rest,
            measured=measured,
            std_ohm=values["std_ohm"],
            frames=int(values["frames"]),
            lost=None if lost < 0 else lost,
            serial_number=str(values["serial_number"]),
            wall_time=float(values["wall_time"]),
            remarks=tuple(str(remark) for remark in values["remarks"].tolist()),
            rest_counts=counts,
        )


@dataclass(frozen=True, slots=True)
class EarlierRest:
    """Earlier rest resistances of the same skin."""

    what: str
    """their origin, for messages"""
    rest_resistance_ohm: FloatArray
    """(rows, columns)"""
    measured: BoolArray
    """(rows, columns)"""


@dataclass(frozen=True, slots=True)
class RestReadings:
    """Frames taken for a tare."""

    resistance_ohm: FloatArray
    """(frames, rows, columns), or counts where the circuit is not known; NaN where not valid"""
    time_s: FloatArray
    """(frames,) increasing"""
    noisy: BoolArray | None = None
    """(rows, columns) cells that only noise keeps from being valid in most frames; None: no cells"""
    without_current: BoolArray | None = None
    """(rows, columns) cells that read no current in most frames: on a broken line, or open at rest; None: none. They
    have no ``resistance_ohm``, since what they show in the other frames is noise"""

    def tare(
        self,
        cell: Cell | None,
        *,
        lost: int | None,
        serial_number: str,
        wall_time: float,
        calibrated_ohm: FloatArray | None = None,
        earlier: EarlierRest | None = None,
        drift: float = KNOWN_DRIFT,
        spread: float = SPREAD,
    ) -> Tare:
        """The rest resistances, with all signs that the skin is loaded.

        Args:
            cell: data sheet, for cells without a reading if there is no calibration; without either they get the median
                of the others.
            lost: frames lost meanwhile.
            serial_number: of the board.
            wall_time: of the last frame, in s since the epoch.
            calibrated_ohm: (rows, columns) rest resistances of a calibration, to compare with instead of the data
                sheet.
            earlier: rest resistances of this skin when it was known to be unloaded.
            drift: relative change since then that is no sign of a load.
            spread: relative deviation of a cell from the others that is no sign of a load.

        Raises:
            InputError: no cell has a valid reading, and cells are not open at rest.

        """
        readings, mean, deviation = self._means()
        measured = readings > 0
        idle = np.zeros_like(measured)
        if cell is not None and cell.open_at_rest and self.without_current is not None:
            idle = self.without_current & ~measured
        if not (measured | idle).any():
            raise InputError("no cell has a valid reading to tare with")
        std = np.sqrt((deviation**2).sum(axis=0) / np.maximum(readings - 1, 1))
        expected = np.ones_like(mean) if calibrated_ohm is None else calibrated_ohm
        sheet = np.nan if cell is None else cell.rest_resistance_ohm
        typical = float(np.median((mean / expected)[measured])) if measured.any() else sheet
        otherwise = typical * expected if cell is None or calibrated_ohm is not None else sheet
        otherwise = np.where(idle, sheet, otherwise)
        unlike = _unlike_others(mean, typical * expected, measured, cell, spread)
        signs = (
            far_from_sheet(typical, cell) if calibrated_ohm is None or idle.all() else _far_from_calibration(typical),
            unlike,
            ""
            if earlier is None
            else _changed_since(earlier, mean, std / np.sqrt(np.maximum(readings, 1)), cell, drift),
            self._changing(mean, readings),
        )
        remarks = tuple(sign for sign in signs if sign)
        frames_advised, spread_advised = 0, 0.0
        if remarks == (unlike,) and not (cell is not None and isinstance(cell.model, ContactModel)):
            ratio = np.where(measured, mean / (typical * expected), 1.0)
            relative = deviation / np.where(measured, mean, 1.0)
            frames_advised = self._frames_to_tell(ratio, relative, readings, spread)
            if not frames_advised:
                spread_advised = _spread_of_all(ratio[measured])
        elif not remarks:
            frames_advised = self._frames_to_cover(measured | idle)
        return Tare(
            rest_resistance_ohm=np.where(measured, mean, otherwise),
            measured=measured | idle,
            std_ohm=np.where(measured, std, np.nan),
            frames=len(self.resistance_ohm),
            lost=lost,
            serial_number=serial_number,
            wall_time=wall_time,
            remarks=remarks,
            frames_advised=frames_advised,
            spread_advised=spread_advised,
        )

    def tare_of_counts(self, *, lost: int | None, serial_number: str, wall_time: float) -> Tare:
        """The mean counts, where the circuit is not known; arguments and errors as for :meth:`tare`.

        Counts at rest may be 0, and what the cells have in common is not known. The only sign of a load is therefore
        that counts change while the frames come.
        """
        readings, mean, _ = self._means()
        if not readings.any():
            raise InputError("no cell has a count to tare with")
        changing, unknown = self._changing(mean, readings, of_counts=True), np.full(mean.shape, np.nan)
        return Tare(
            rest_resistance_ohm=unknown,
            measured=readings > 0,
            std_ohm=unknown,
            frames=len(self.resistance_ohm),
            lost=lost,
            serial_number=serial_number,
            wall_time=wall_time,
            remarks=(changing,) if changing else (),
            rest_counts=mean,
        )

    def _means(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(rows, columns) number and mean of valid readings; (frames, rows, columns) deviation, 0 if not valid."""
        valid = np.isfinite(self.resistance_ohm)
        readings = valid.sum(axis=0)
        mean = np.nansum(self.resistance_ohm, axis=0) / np.maximum(readings, 1)
        return readings, mean, np.where(valid, self.resistance_ohm - mean, 0.0)

    def _frames_to_tell(self, ratio: FloatArray, deviation: FloatArray, readings: FloatArray, spread: float) -> int:
        """Number of frames with which noise moves no cell from the others by more than its share of ``spread``.

        Args:
            ratio: (rows, columns) of the cells to their usual values.
            deviation: (frames, rows, columns) relative deviation of the readings from their mean; 0 where not valid.
            readings: (rows, columns) number of valid readings.
            spread: relative deviation of a cell from the others that manufacturing tolerances explain.

        Returns:
            The number, rounded up to two digits; 0 if noise does not suffice to explain the ratios.

        """
        squares, degrees = (deviation**2).sum(axis=0), np.maximum(readings - 1, 0)
        variance = squares.sum() / max(degrees.sum(), 1)
        # A few readings of a cell give a poor estimate of its noise.
        own = np.sqrt((squares + TYPICAL_READINGS * variance) / (degrees + TYPICAL_READINGS))
        beyond = np.abs(ratio - 1) - spread
        unlike = beyond > 0
        # Boards measure currents, so the noise is that of a conductance; in a resistance it grows with the resistance.
        if (beyond > SURE_STDS * own * ratio / np.sqrt(np.maximum(readings, 1)))[unlike].any():
            return 0
        enough = float((SURE_STDS * own[unlike].max() / (NOISE_SHARE * spread)) ** 2)
        # Cells with rarely valid readings decide. A column's are valid together, in some columns ten times as often.
        return _two_digits(len(self.time_s) * max(enough / float(readings[readings > 0].min()), 2.0))

    def _frames_to_cover(self, measured: BoolArray) -> int:
        """Number of frames in which nearly all noisy cells have readings, rounded up to two digits; 0: none is hidden.

        Valid readings of such cells are rare and independent events. The share of cells without one gives the number of
        readings of the usual cell.
        """
        if self.noisy is None or not (self.noisy & ~measured).any():
            return 0
        noisy = np.count_nonzero(self.noisy)
        unseen = np.count_nonzero(self.noisy & ~measured)
        seen = -math.log(min(unseen, noisy - 0.5) / noisy)  # readings of the usual cell
        return _two_digits(len(self.time_s) * max(ENOUGH_READINGS / max(seen, 0.5 / noisy), 2.0))

    def _changing(self, mean: FloatArray, readings: FloatArray, *, of_counts: bool = False) -> str:
        """A remark where a reading has a trend: a load that comes or goes, or a cell that recovers from one."""
        frames = len(self.time_s)
        if frames < 4:
            return ""
        half = frames // 2
        valid = np.isfinite(self.resistance_ohm)
        steady = np.where(valid, self.resistance_ohm, mean)
        change = np.abs(steady[-half:].mean(axis=0) - steady[:half].mean(axis=0))
        # Noise from differences between successive frames, so that a trend does not count as noise.
        noise = np.sqrt((np.diff(steady, axis=0) ** 2).mean(axis=0) / 2)
        # Few frames give a poor estimate of one cell's noise: it counts as at least that of the median cell.
        every = readings == frames
        if every.any():
            noise = np.maximum(noise, mean * np.median((noise / np.maximum(mean, 1e-300))[every]))
        limit = np.maximum(DRIFT_COUNTS if of_counts else DRIFT * mean, SURE_STDS * noise * np.sqrt(2 / half))
        moving = every & (change > limit)
        if not moving.any():
            return ""
        share = change if of_counts else 100 * change / np.maximum(mean, 1e-300)
        worst = _worst(np.where(moving, share, 0.0))
        what, by = ("counts", f"{share[worst]:.1f}") if of_counts else ("resistance", f"{share[worst]:.1f} %")
        return (
            f"the {what} of {_cells(moving)} {'are' if of_counts else 'is'} changing, most at cell {worst} by {by} in "
            f"{self.time_s[-1] - self.time_s[0]:.2g} s"
        )


def _two_digits(number: float) -> int:
    """A number of at least 1, rounded up to two digits."""
    digits = max(math.floor(math.log10(number)) - 1, 0)
    return math.ceil(number * 10.0**-digits) * int(10.0**digits)


def far_from_sheet(typical_ohm: float, cell: Cell | None) -> str:
    """A remark if the typical resistance is not that of a cell at rest; else empty."""
    if cell is None:
        return ""
    ratio = typical_ohm / cell.rest_resistance_ohm
    # Electrodes in light contact may have any resistance above that of the data sheet.
    if 1 / SHEET_FACTOR <= ratio <= (np.inf if cell.falls else SHEET_FACTOR):
        return ""
    return (
        f"the typical resistance is {typical_ohm:.4g} ohm, {ratio:.2g} times the {cell.rest_resistance_ohm:.4g} ohm "
        "that the data sheet gives for rest"
    )


def _far_from_calibration(ratio: float) -> str:
    if 1 / SHEET_FACTOR <= ratio <= SHEET_FACTOR:
        return ""
    return f"the typical resistance is {ratio:.2g} times that of the calibration at rest"


def _unlike_others(
    mean_ohm: FloatArray, usual_ohm: FloatArray, measured: BoolArray, cell: Cell | None, spread: float
) -> str:
    """A remark if cells differ by more than ``spread`` from their usual values, by the readings of the others."""
    if cell is not None and isinstance(cell.model, ContactModel):
        return _conducting(mean_ohm, usual_ohm, measured, cell.model, cell.full_scale_kpa)
    ratio = mean_ohm / usual_ohm
    unlike = measured & (np.abs(ratio - 1) > spread)
    if not unlike.any():
        return ""
    worst = _worst(np.where(unlike, np.abs(ratio - 1), 0.0))
    differ = "differs" if unlike.sum() == 1 else "differ"
    return f"{_cells(unlike)} {differ} from the others, most cell {worst} with {ratio[worst]:.2f} times their median"


def _spread_of_all(ratio: FloatArray) -> float:
    """Largest relative deviation of resistances (n,), in units of the usual one, rounded up; 0: there are outliers."""
    deviation = np.abs(np.log(np.maximum(ratio, 1e-300)))
    if deviation.max() > OUTLYING_STDS * scatter(deviation):
        return 0.0
    return math.ceil(10 * float(np.abs(ratio - 1).max())) / 10


def _conducting(
    mean_ohm: FloatArray, usual_ohm: FloatArray, measured: BoolArray, model: ContactModel, full_scale_kpa: float
) -> str:
    """The same for electrodes that touch: any resistance above the usual one counts as rest, like an open contact."""
    load = np.where(measured, _contact_load(mean_ohm, usual_ohm, model), 0.0)
    loaded = load > CONTACT_LOAD
    if not loaded.any():
        return ""
    worst = _worst(load)
    conduct = "conducts" if loaded.sum() == 1 else "conduct"
    return (
        f"{_cells(loaded)} {conduct} as under a load, most cell {worst} as under {full_scale_kpa * load[worst]:.2g} kPa"
    )


def _contact_load(resistance_ohm: FloatArray, rest_ohm: FloatArray, model: ContactModel) -> FloatArray:
    """Share of full scale at which touching electrodes have this resistance; 0 if it is not below rest."""
    with np.errstate(divide="ignore"):
        conductance = np.maximum(1 / resistance_ohm - 1 / rest_ohm, 0.0)
    return np.asarray((conductance * model.full_scale_resistance_ohm) ** (1 / model.exponent))


def _changed_since(
    earlier: EarlierRest, mean: FloatArray, std_error: FloatArray, cell: Cell | None, drift: float
) -> str:
    """A remark if cells have changed by more than ``drift`` since then, in the direction of a load.

    A change in the other direction is no sign: the skin was loaded then, and is not now. Without a cell model both
    directions count.
    """
    ratio = mean / earlier.rest_resistance_ohm
    change = np.abs(ratio - 1) if cell is None else _sign_of_load(cell) * (ratio - 1)
    noise = SURE_STDS * std_error / earlier.rest_resistance_ohm
    changed = earlier.measured & (mean > 0) & (change > np.maximum(drift, noise))
    if cell is not None and isinstance(cell.model, ContactModel):
        changed &= _contact_load(mean, earlier.rest_resistance_ohm, cell.model) > CONTACT_LOAD
    if not changed.any():
        return ""
    typical = float(np.median(ratio[earlier.measured & (mean > 0)]))
    worst = _worst(np.where(changed, change, 0.0))
    return (
        f"{_cells(changed)} of {changed.size} changed by more than {100 * drift:.3g} % since {earlier.what}, most "
        f"cell {worst} to {ratio[worst]:.2f} and the typical one to {typical:.2f} times the resistance of then"
    )


def _sign_of_load(cell: Cell) -> float:
    """1.0 if a load raises the resistance, -1.0 if it lowers it."""
    return -1.0 if cell.falls else 1.0


def _worst(amount: FloatArray) -> tuple[int, int]:
    row, column = np.unravel_index(int(np.argmax(amount)), amount.shape)
    return int(row), int(column)


def _cells(mask: BoolArray) -> str:
    return count_of(int(mask.sum()), "cell")
