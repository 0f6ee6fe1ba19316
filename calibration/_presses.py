"""What is measured for a calibration: the skin at rest, and presses with a known load. No I/O."""

from __future__ import annotations

from dataclasses import dataclass

from ..arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """The unloaded skin before the first press. Arrays are (rows, columns)."""

    time_s: float
    """middle of the window"""
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
    """One press: a load on some cells, held and taken off again."""

    cells: IntArray
    """(k,) cells that bore the load, as indices into the flattened array"""
    time_s: FloatArray
    """(n,) increasing: corners of the load over time"""
    load_kpa: FloatArray
    """(n,) load at the corners; straight lines between them, none before and after"""
    window_s: FloatArray
    """(w,) middles of the windows over which readings were averaged: one just before the press, the others while it
    was held"""
    resistance_ohm: FloatArray
    """(w, k) means; NaN where there was no valid reading"""
    std_ohm: FloatArray
    """(k,) standard deviation from frame to frame while the load was held"""
    frames: int
    """averaged in each window"""
    step: int
    """number of the step of the plan that it was meant for"""
    felt_kpa: float
    """mean load on the target while it was held, as the common cell model has it"""
    fault: str = ""
    """why its readings are not used. The cells remember such a press, too"""

    @property
    def held_kpa(self) -> float:
        """The largest load."""
        return float(self.load_kpa.max())
