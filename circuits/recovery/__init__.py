"""From readings back to cells: the circuit model inverted, with how far each cell can be off.

===========================  =============================================================================
:mod:`._recover`             one frame, to certified bounds: :func:`recover`
:mod:`._inversion`           its equations: fixed-point iteration, then Newton's method
:mod:`._live`                a stream, in bounded time per frame: :func:`live_recovery`
:mod:`._amplified`           for amplifiers that hold their lines, where readings are nearly apart: a frame's way
:mod:`._amplified_board`     lines, amplifiers and converter there; first-order bounds
:mod:`._amplified_base`      its cells by line attenuation, relinearised about a base
:mod:`._amplified_leads`     by Kirchhoff's laws beside heavy leads (:mod:`._heavy_leads`)
:mod:`._amplified_errors`    how far its cells can be off by quantisation and noise
:mod:`._amplified_limits`    which cells others at limits would disturb; :mod:`._joined_columns`: through two shorts
:mod:`._coupled`             for circuits in which every cell moves every reading: the stages of a frame
:mod:`._coupled_board`       the board and its circuit model there
:mod:`._readings_at_limits`  which readings a fit leaves out
:mod:`._closed_start`        where it begins
:mod:`._gauss_newton`        its steps, within the :mod:`._frame_budget`
:mod:`._linearised`          the derivatives that are kept from frame to frame
:mod:`._fit_uncertainty`     how far its cells can be off
:mod:`._column_scales`       by columns of dividers whose readings leave their scale open
:mod:`._below_range`         by cells whose readings lie below the converter's range
:mod:`._possible_shorts`     which cells may be shorts, and which others such shorts would disturb
:mod:`._live_reading`        what a stream gives: conductances, uncertainties, reasons
:mod:`._quick_model`         readings of given cells, to a part of an ADC step
:mod:`._derivatives`         derivatives of readings, a few at a time
:mod:`._normal_matrix`       steps by all derivatives; :mod:`._column_blocks`: by those within a column
:mod:`._lines`               the shared wire of a line's cells
===========================  =============================================================================
"""

from ._conditioning import Conditioning, conditioning
from ._live import live_recovery
from ._live_reading import LiveReading, LiveRecovery, Reason, ValidityRule
from ._recover import Recoverer, recover
from ._recovered import Recovery, Status

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
