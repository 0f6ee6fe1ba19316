"""Measurements of a calibration: the skin at rest, and presses with known loads. No I/O."""

from __future__ import annotations

from dataclasses import dataclass

from ..common.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """The unloaded skin before the first press. Arrays are (rows, columns)."""

    time_s: float
    """middle of the averaging window"""
    resistance_ohm: FloatArray
    """mean; NaN where there was no valid reading"""
    std_ohm: FloatArray
    """standard deviation from frame to frame"""
    change: FloatArray
    """relative change from the first to the second half of the window"""
    frames: int

    @property
    def measured(self) -> BoolArray:
        """(rows, columns) cells that had a valid reading."""
        found: BoolArray = self.resistance_ohm > 0
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """One press: a load that is put on some cells, held, and taken off."""

    cells: IntArray
    """(k,) cells under the load, as indices into the flattened array"""
    time_s: FloatArray
    """(n,) increasing: times of the corners of the load, which is piecewise linear"""
    load_kpa: FloatArray
    """(n,) load at the corners; 0 before and after"""
    window_s: FloatArray
    """(w,) middles of the averaging windows: one just before the press, the others while the load was held"""
    resistance_ohm: FloatArray
    """(w, k) means over the windows; NaN where there was no valid reading"""
    std_ohm: FloatArray
    """(k,) standard deviation from frame to frame while the load was held"""
    frames: int
    """number of frames in the last window under load"""
    step: int
    """number of the step of the plan to which the press belongs"""
    felt_kpa: float
    """mean load on the target during the hold, as estimated with the common cell model"""
    fault: str = ""
    """why the readings are not used; empty: they are. A press with a fault still changes the memory of the cells"""

    @property
    def held_kpa(self) -> float:
        """The largest load."""
        return float(self.load_kpa.max())
