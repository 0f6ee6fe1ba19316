"""A client's recording against the emulator's truth: errors of pressure and of place, latency, and losses.

A recording is a NumPy archive (.npz) as ``ohmskin export`` writes it:

==============  ===================  ==========================================================================
array           shape                content
==============  ===================  ==========================================================================
``sequence``    (F,)                 number of each frame, as the board sent it
``time``        (F,)                 s, when the frame was complete at the host, by any clock
``pressure``    (F, rows, columns)   kPa on each cell
``valid``       (F, rows, columns)   optional: whether the host vouches for the cell; else where pressure is finite
==============  ===================  ==========================================================================

Frames of recording and truth belong together if they have the same number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from scipy.ndimage import center_of_mass, label
from scipy.optimize import linear_sum_assignment

from ..common.archives import Stored, check_arrays, read_arrays
from ..common.arrays import AnyArray, BoolArray, FloatArray, IntArray
from ..common.config import MOST_SI
from ..errors import InputError
from ._tuning import CONTACT_SHARE, LARGEST_PACE, LONGEST_DELAY_S, PAIR_CELLS, REST_SHARE

MOST_BYTES = 4 << 30
"""size limit of a file in memory: 1 h of 16 x 16 cells at 100 Hz takes 2.2 GB per quantity"""
_CELLS = ("frames", "rows", "columns")
_RECORDING = "recording as ohmskin export writes it"
_RECORDED = {
    "sequence": Stored("whole numbers", _CELLS[:1]),
    "time": Stored("numbers", _CELLS[:1], -MOST_SI, MOST_SI),
    "pressure": Stored("numbers", _CELLS, nan=True),
    "valid": Stored("flags", _CELLS, optional=True),
}
_TRUE = {
    "sequence": Stored("whole numbers", _CELLS[:1]),
    "time_s": Stored("numbers", _CELLS[:1], -MOST_SI, MOST_SI),
    "pressure_kpa": Stored("numbers", _CELLS, nan=True),
    "pitch_mm": Stored("numbers", least=0.0, most=MOST_SI, nan=True, optional=True),
    "full_scale_kpa": Stored("numbers", least=0.0, most=MOST_SI, nan=True, optional=True),
}


@dataclass(frozen=True)
class Recording:
    """What a client made of a board's frames. Arrays as in the table above, with ``valid`` filled in."""

    sequence: IntArray
    time: FloatArray
    pressure: FloatArray
    valid: BoolArray

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an archive; InputError says what is missing or does not fit."""
        return cls.of(read_arrays(path, _RECORDED, what=_RECORDING, most_bytes=MOST_BYTES), path)

    @classmethod
    def of(cls, given: Mapping[str, AnyArray], path: str | Path) -> Self:
        """Check arrays that came from ``path``; InputError says what is missing or does not fit."""
        arrays = check_arrays(given, _RECORDED, path=path, what=_RECORDING)
        _check_not_empty(path, arrays)
        valid = np.isfinite(arrays["pressure"])
        return cls(arrays["sequence"], arrays["time"], arrays["pressure"], valid & arrays.get("valid", valid))


@dataclass(frozen=True)
class Truth:
    """What the emulator knows."""

    sequence: IntArray
    time_s: FloatArray
    pressure_kpa: FloatArray
    pitch_mm: float
    """NaN where the file does not say"""
    full_scale_kpa: float

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read FILE.npz, or the spool that a killed emulator has left; InputError."""
        arrays = read_arrays(path, _TRUE, what="truth file of ohmskin emulate", most_bytes=MOST_BYTES)
        _check_not_empty(path, arrays)
        numbers = {name: float(arrays.get(name, np.nan)) for name in ("pitch_mm", "full_scale_kpa")}
        return cls(arrays["sequence"], arrays["time_s"], arrays["pressure_kpa"], **numbers)


@dataclass(frozen=True)
class Score:
    """How a recording compares with the truth. Errors count valid cells of frames that are in both."""

    frames: int
    """in both"""
    lost_frames: int
    """scanned between the first and the last recorded one, but not recorded"""
    repeated_frames: int
    """recorded again under the same number; the last one counts"""
    unknown_frames: int
    """recorded under a number that the truth does not have"""
    valid_percent: float
    """of the cells of the frames in both"""
    full_scale_kpa: float
    rmse_kpa: float
    rmse_percent: float
    """of full scale"""
    pressed_rmse_kpa: float
    """of the cells and frames that are pressed in truth; NaN where none is"""
    pressed_rmse_percent: float
    worst_kpa: float
    worst_percent: float
    worst_at: tuple[int, int, int]
    """sequence number, row and column of the worst error"""
    rest_error_kpa: float
    """rms over the cells of each one's median error while it is at rest in truth; NaN where no cell ever is"""
    rest_contact_cells: int
    """cells whose median at rest is above the threshold of a contact: each makes false contacts in most frames"""
    contacts: int
    """contacts in truth, summed over the frames"""
    contacts_missed: int
    contacts_false: int
    """in the recording only"""
    location_rms: float
    """distance of contacts from their true place, in ``location_unit``; NaN where none was found"""
    location_worst: float
    location_unit: str
    """mm; or cells, where the pitch is not known"""
    arrival_spread_ms: float
    """95th percentile of (time at the host - time of the scan), above the fastest frame; NaN if not in real time"""
    arrival_worst_ms: float
    delay_ms: float
    """by which the recorded pressure follows the truth, both at their frame's number: the estimator's delay"""


def score(
    recording: Recording, truth: Truth, *, pitch_mm: float | None = None, full_scale_kpa: float | None = None
) -> Score:
    """Compare them.

    Args:
        recording: of a client.
        truth: of the board that it listened to.
        pitch_mm: from cell to cell, for the places; None: what the truth says.
        full_scale_kpa: None: what the truth says, else its largest pressure.

    Raises:
        InputError: the arrays differ in shape, or no frame is in both.

    """
    if recording.pressure.shape[1:] != truth.pressure_kpa.shape[1:]:
        raise InputError(
            f"the recording has frames of {recording.pressure.shape[1:]} cells, the truth of "
            f"{truth.pressure_kpa.shape[1:]}; expected the same array"
        )
    # Of a number that was recorded twice the last frame counts: the first of the reversed array.
    numbers_back, first = np.unique(recording.sequence[::-1], return_index=True)
    latest = len(recording.sequence) - 1 - first
    _, in_recording, in_truth = np.intersect1d(numbers_back, truth.sequence, return_indices=True)
    if not len(in_truth):
        raise InputError("no frame number is in both the recording and the truth: they are not of the same run")
    pitch = truth.pitch_mm if pitch_mm is None else pitch_mm
    full = truth.full_scale_kpa if full_scale_kpa is None else full_scale_kpa
    if not np.isfinite(full):
        full = float(truth.pressure_kpa.max())
    if not full > 0:
        raise InputError("full scale is not known, since nothing presses in truth; expected full_scale_kpa")

    found = latest[in_recording]
    estimate, expected = recording.pressure[found], truth.pressure_kpa[in_truth]
    valid = recording.valid[found]
    error = np.where(valid, np.abs(estimate - expected), 0.0)
    pressed = valid & (expected > 0)
    worst = np.unravel_index(int(error.argmax()), error.shape)
    rmse, pressed_rmse = _rms(error[valid]), _rms(error[pressed])
    at_rest = _errors_at_rest(estimate - expected, valid & (expected <= REST_SHARE * full))
    places = _compare_contacts(np.where(valid, estimate, 0.0), expected, CONTACT_SHARE * full)
    unit = pitch if np.isfinite(pitch) else 1.0
    arrived, scanned = recording.time[found], truth.time_s[in_truth]
    late = 1000.0 * (arrived - scanned - (arrived - scanned).min())
    if len(found) > 1 and not 1.0 / LARGEST_PACE < np.polyfit(scanned, arrived, 1)[0] < LARGEST_PACE:
        late[:] = np.nan
    return Score(
        frames=len(in_truth),
        lost_frames=int(in_truth.max() - in_truth.min()) + 1 - len(in_truth),
        repeated_frames=len(recording.sequence) - len(numbers_back),
        unknown_frames=len(numbers_back) - len(in_truth),
        valid_percent=100.0 * float(valid.mean()),
        full_scale_kpa=full,
        rmse_kpa=rmse,
        rmse_percent=100.0 * rmse / full,
        pressed_rmse_kpa=pressed_rmse,
        pressed_rmse_percent=100.0 * pressed_rmse / full,
        worst_kpa=float(error.max()),
        worst_percent=100.0 * float(error.max()) / full,
        worst_at=(int(truth.sequence[in_truth[worst[0]]]), int(worst[1]), int(worst[2])),
        rest_error_kpa=_rms(at_rest),
        rest_contact_cells=int((at_rest > CONTACT_SHARE * full).sum()),
        contacts=places.contacts,
        contacts_missed=places.missed,
        contacts_false=places.false,
        location_rms=_rms(places.distances) * unit,
        location_worst=float(np.max(places.distances, initial=0.0)) * unit if len(places.distances) else np.nan,
        location_unit="mm" if np.isfinite(pitch) else "cells",
        arrival_spread_ms=float(np.percentile(late, 95)),
        arrival_worst_ms=float(late.max()),
        delay_ms=1000.0 * _delay_s(np.where(valid, estimate, np.nan), truth, in_truth),
    )


def _errors_at_rest(error: FloatArray, at_rest: BoolArray) -> FloatArray:
    """Median error of each cell over its frames at rest, without the cells that have none."""
    known = np.where(at_rest, error, np.nan)[:, at_rest.any(axis=0)]
    return np.asarray(np.nanmedian(known, axis=0))


@dataclass(frozen=True)
class _Places:
    contacts: int
    missed: int
    false: int
    distances: FloatArray
    """in cells"""


def _compare_contacts(estimate: FloatArray, expected: FloatArray, threshold: float) -> _Places:
    """Contacts of all frames, paired within each frame so that the sum of their distances is least."""
    contacts = missed = false = 0
    distances: list[FloatArray] = []
    for seen, real in zip(estimate, expected, strict=True):
        if not (seen.max() > threshold or real.max() > threshold):
            continue
        there, here = _contacts(real, threshold), _contacts(seen, threshold)
        apart = np.linalg.norm(there[:, None] - here[None], axis=2)
        paired = apart[linear_sum_assignment(np.minimum(apart, 2.0 * PAIR_CELLS))]
        same = paired[paired <= PAIR_CELLS]
        contacts += len(there)
        missed += len(there) - len(same)
        false += len(here) - len(same)
        distances.append(same)
    return _Places(contacts, missed, false, np.concatenate(distances) if distances else np.empty(0))


def _contacts(pressure: FloatArray, threshold: float) -> FloatArray:
    """(contacts, 2) centres of pressure, [row, column], of the patches of cells above the threshold.

    Cells that touch at a corner are of one patch.
    """
    patches, count = label(pressure > threshold, structure=np.ones((3, 3)))
    if not count:
        return np.empty((0, 2))
    return np.array(center_of_mass(pressure, patches, np.arange(1, count + 1)))


def _delay_s(estimate: FloatArray, truth: Truth, in_truth: IntArray) -> float:
    """By how many seconds the truth must be delayed to look most like the estimate; NaN where nothing changes."""
    moving = np.flatnonzero(np.ptp(truth.pressure_kpa, axis=0).ravel() > 0)
    if len(truth.time_s) < 3 or not len(moving):
        return np.nan
    period = float(np.median(np.diff(truth.time_s)))
    if not period > 0:
        return np.nan
    reference = truth.pressure_kpa.reshape(len(truth.time_s), -1)[:, moving]
    seen = estimate.reshape(len(in_truth), -1)[:, moving]
    most = int(min(LONGEST_DELAY_S / period, len(truth.time_s) // 2, 1000))
    misfit = np.full(most + 1, np.inf)
    for frames in range(most + 1):
        known = in_truth >= most  # the same frames for every delay
        if known.any():
            apart = seen[known] - reference[in_truth[known] - frames]
            misfit[frames] = np.nanmean(apart**2) if np.isfinite(apart).any() else np.inf
    best = int(misfit.argmin())
    if not np.isfinite(misfit[best]):
        return np.nan
    shift = 0.0
    if 0 < best < most and np.isfinite(misfit[best + 1]):  # the vertex of a parabola through three points
        before, here, after = misfit[best - 1 : best + 2]
        bend = before - 2.0 * here + after
        shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return (best + float(shift)) * period


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def _check_not_empty(path: str | Path, arrays: Mapping[str, AnyArray]) -> None:
    if not arrays["sequence"].size:
        raise InputError(f"{path}: has no frames")


def score_text(result: Score) -> str:
    """The score as lines for a terminal."""
    sequence, row, column = result.worst_at
    unit = result.location_unit
    lines = [
        ("frames", f"{result.frames} compared, {result.lost_frames} lost"),
        ("", f"{result.repeated_frames} repeated, {result.unknown_frames} unknown to the truth"),
        ("valid cells", f"{result.valid_percent:.2f} %"),
        ("RMSE, all cells", f"{result.rmse_kpa:.3g} kPa, {result.rmse_percent:.2f} % of full scale"),
        (
            "RMSE, pressed cells",
            _known(
                result.pressed_rmse_kpa,
                f"{result.pressed_rmse_kpa:.3g} kPa, {result.pressed_rmse_percent:.2f} % of full scale",
                otherwise="no cell is pressed",
            ),
        ),
        ("worst error", f"{result.worst_kpa:.3g} kPa, {result.worst_percent:.2f} % of full scale"),
        ("", f"in frame {sequence}, row {row}, column {column}"),
        (
            "steady error at rest",
            _known(result.rest_error_kpa, f"{result.rest_error_kpa:.3g} kPa rms", otherwise="no cell is ever at rest"),
        ),
        ("contacts", f"{result.contacts}, {result.contacts_missed} missed, {result.contacts_false} false"),
        *_cause_of_false_contacts(result.rest_contact_cells),
        (
            "location error",
            _known(
                result.location_rms,
                f"{result.location_rms:.3g} {unit} rms, {result.location_worst:.3g} {unit} at worst",
                otherwise="no contact is there to compare",
            ),
        ),
        (
            "arrival",
            _known(
                result.arrival_worst_ms,
                f"95 % within {result.arrival_spread_ms:.3g} ms of the fastest, worst {result.arrival_worst_ms:.3g} ms",
                otherwise="the board did not run in real time",
            ),
        ),
        (
            "delay of the pressure",
            _known(result.delay_ms, f"{result.delay_ms:.3g} ms", otherwise="not to be told from these frames"),
        ),
    ]
    return "\n".join(f"{name:<22} {text}" for name, text in lines)


def _cause_of_false_contacts(cells: int) -> list[tuple[str, str]]:
    """A line about cells that read as pressed at rest, where there are any."""
    if not cells:
        return []
    read = "1 cell reads" if cells == 1 else f"{cells} cells read"
    return [
        ("", f"{read} above {100 * CONTACT_SHARE:.0f} % of full scale at rest, and so as false contacts:"),
        ("", "the skin was probably not tared; tare or calibrate it before it is recorded"),
    ]


def _known(value: float, text: str, *, otherwise: str) -> str:
    """``text`` about ``value``, or what to say where there is none (NaN)."""
    return text if np.isfinite(value) else otherwise
