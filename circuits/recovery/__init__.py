"""From readings back to cells: the circuit model inverted, with how far each cell can be off.

========================  =============================================================================
:mod:`._recover`          one frame, to certified bounds: :func:`recover`
:mod:`._inversion`        its equations: fixed-point iteration, then Newton's method
:mod:`._live`             a stream, in bounded time per frame: :func:`live_recovery`
:mod:`._amplified`        for amplifiers that hold their lines, where readings are nearly apart; names its parts
:mod:`._coupled`          for circuits in which every cell moves every reading
:mod:`._live_reading`     what a stream gives: conductances, uncertainties, reasons
:mod:`._quick_model`      readings of given cells, to a part of an ADC step
:mod:`._derivatives`      derivatives of readings, a few at a time
:mod:`._normal_matrix`    steps by all derivatives; :mod:`._column_blocks`: by those within a column
:mod:`._lines`            the shared wire of a line's cells
========================  =============================================================================
"""

from ._live import live_recovery
from ._live_reading import LiveReading, LiveRecovery, Reason, ValidityRule
from ._recover import Conditioning, Recoverer, Recovery, Status, conditioning, recover

__all__ = [
    "Conditioning",
    "LiveReading",
    "LiveRecovery",
    "Reason",
    "Recoverer",
    "Recovery",
    "Status",
    "ValidityRule",
    "conditioning",
    "live_recovery",
    "recover",
]
