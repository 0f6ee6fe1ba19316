"""Inverse problem of a resistive array: from readings back to cells, with an error bound for each cell.

One frame, with certified bounds:

============================  =====================================================================================
:mod:`._recover`              the stages for one frame: :func:`recover`
:mod:`._independent_columns`  closed form where columns are independent
:mod:`._inversion`            elsewhere: fixed-point iteration, then Newton's method (:mod:`._jacobian`)
:mod:`._frame_model`          readings as a function of the cells
:mod:`._unknown`              cells whose readings bound them on one side only
:mod:`._envelope`             intervals of the others beside these
:mod:`._determined`           cells that the readings determine at all
:mod:`._conditioning`         propagation of errors from the readings to the cells
:mod:`._recovered`            the result: resistances, status, uncertainties
============================  =====================================================================================

A stream, in bounded time per frame (:mod:`._frame_account`), begins with :func:`live_recovery` in :mod:`._live`, and
gives a :mod:`._live_reading` for each frame: conductances, uncertainties, reasons. For amplifiers that hold their
lines, where each reading depends on little but its own cell:

============================  =====================================================================================
:mod:`._amplified`            the stages of a frame, also by :mod:`._amplified_loops`; :mod:`._amplified_prices`
:mod:`._amplified_board`      lines, amplifiers and converter; first-order bounds
:mod:`._amplified_base`       cells by line attenuation, relinearised about a base
:mod:`._amplified_leads`      by Kirchhoff's laws beside heavy leads (:mod:`._heavy_leads`)
:mod:`._amplified_errors`     errors of cells by quantisation and noise
:mod:`._amplified_limits`     cells that others at limits would disturb, also by :mod:`._amplified_short_loops`
:mod:`._joined_columns`       currents between columns that shorts on one row join
============================  =====================================================================================

For circuits in which every cell moves every reading:

============================  =====================================================================================
:mod:`._coupled`              the stages of a frame; :mod:`._coupled_prices`
:mod:`._coupled_board`        the board and its circuit model
:mod:`._readings_at_limits`   readings that a fit leaves out
:mod:`._broken_lines`         effect of lines that broke meanwhile on the readings
:mod:`._closed_start`         start of the fit, by closed formulas
:mod:`._gauss_newton`         steps of the fit, within the :mod:`._frame_budget`
:mod:`._linearised`           the derivatives that are kept from frame to frame
:mod:`._column_blocks`        steps by derivatives within a column; by loops: :mod:`._coupled_loops`
:mod:`._node_blocks`          steps on boards with floating rows
:mod:`._normal_matrix`        steps by all derivatives
:mod:`._derivatives`          all derivatives, a few at a time; :mod:`._port_derivatives`: products with them
:mod:`._quick_model`          readings of given cells, to a part of an ADC step; :mod:`._sheet_model`: of a sheet
:mod:`._lines`                the shared wire of a line's cells
:mod:`._fit_uncertainty`      errors of cells by quantisation and noise
:mod:`._column_scales`        errors by columns of dividers whose readings do not fix their scale
:mod:`._follower_solutions`   errors by other cells with the same readings of a follower (:mod:`._follower_law`)
:mod:`._below_range`          errors by cells whose readings lie below the converter's range
:mod:`._lost_rows`            errors by rows of followers with readings at a limit
:mod:`._possible_shorts`      cells that may be shorts, and cells that such shorts would disturb
============================  =====================================================================================
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
