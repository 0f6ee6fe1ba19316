"""Conductances of one frame with what is known of their errors: what the circuit's inverse hands to an estimator."""

from __future__ import annotations

from dataclasses import dataclass

from .arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """One frame of cells. Arrays are (rows, columns), in siemens, and never change again.

    A cell's conductance is ``conductance + noise + column_std * z + step``: noise of its own with variance
    ``noise_variance``, independent from frame to frame; one standard normal ``z`` per column and frame, which all cells
    of the column share; and a quantisation error of at most ``half_step``, which stays while the counts stay.
    Independently of these, the true conductance lies between ``least`` and ``greatest``.

    A reading at a limit of the converter is an interval, not a gap: its ``conductance`` is NaN and ``least`` or
    ``greatest`` is finite. A cell of which nothing is known has NaN, 0 and infinity.
    """

    conductance: FloatArray
    """NaN where only the bounds are known"""
    noise_variance: FloatArray
    """S^2, by noise of the cell's own reading"""
    column_std: FloatArray
    """S, by errors that the cells of a column share; signed: errors of one sign move two cells of a column by the signs
    of their entries"""
    half_step: FloatArray
    """S, half a step of the ADC"""
    least: FloatArray
    """lower bound on the conductance; 0 where there is none"""
    greatest: FloatArray
    """upper bound on the conductance; infinity where there is none"""
