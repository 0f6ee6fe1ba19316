"""From readings back to cells: the circuit model inverted, with how far each cell can be off.

One frame, to certified bounds:

============================  =====================================================================================
:mod:`._recover`              the way of a frame: :func:`recover`
:mod:`._independent_columns`  closed form where columns are independent
:mod:`._inversion`            elsewhere: fixed-point iteration, then Newton's method (:mod:`._jacobian`)
:mod:`._frame_model`          readings as a function of the cells
:mod:`._unknown`              cells whose readings bound them on one side only
:mod:`._envelope`             intervals of the others beside these
:mod:`._determined`           cells that the readings determine at all
:mod:`._conditioning`         how errors of readings propagate to the cells
:mod:`._recovered`            what it gives: resistances, status, uncertainties
============================  =====================================================================================

A stream, in bounded time per frame (:mod:`._frame_account`), begins with :func:`live_recovery` in :mod:`._live`, and
gives a :mod:`._live_reading` for each frame: conductances, uncertainties, reasons. For amplifiers that hold their
lines, where readings are nearly apart:

============================  =====================================================================================
:mod:`._amplified`            the way of a frame, also by :mod:`._amplified_loops`; :mod:`._amplified_prices`
:mod:`._amplified_board`      lines, amplifiers and converter; first-order bounds
:mod:`._amplified_base`       cells by line attenuation, relinearised about a base
:mod:`._amplified_leads`      by Kirchhoff's laws beside heavy leads (:mod:`._heavy_leads`)
:mod:`._amplified_errors`     how far cells can be off by quantisation and noise
:mod:`._amplified_limits`     which cells others at limits would disturb, also by :mod:`._amplified_short_loops`
:mod:`._joined_columns`       currents between columns that shorts on one row join
============================  =====================================================================================

For circuits in which every cell moves every reading:

============================  =====================================================================================
:mod:`._coupled`              the stages of a frame; :mod:`._coupled_prices`
:mod:`._coupled_board`        the board and its circuit model
:mod:`._readings_at_limits`   which readings a fit leaves out
:mod:`._broken_lines`         what lines that broke meanwhile do to readings
:mod:`._closed_start`         where the fit begins
:mod:`._gauss_newton`         its steps, within the :mod:`._frame_budget`
:mod:`._linearised`           the derivatives that are kept from frame to frame
:mod:`._column_blocks`        steps by derivatives within a column; by loops: :mod:`._coupled_loops`
:mod:`._node_blocks`          steps on boards with floating rows
:mod:`._normal_matrix`        steps by all derivatives
:mod:`._derivatives`          these, a few at a time; :mod:`._port_derivatives`: products with them
:mod:`._quick_model`          readings of given cells, to a part of an ADC step; :mod:`._sheet_model`: of a sheet
:mod:`._lines`                the shared wire of a line's cells
:mod:`._fit_uncertainty`      how far cells can be off by quantisation and noise
:mod:`._column_scales`        by columns of dividers whose readings leave their scale open
:mod:`._follower_solutions`   by other cells that give a follower's readings as well (:mod:`._follower_law`)
:mod:`._below_range`          by cells whose readings lie below the converter's range
:mod:`._lost_rows`            by rows of followers with readings at a limit
:mod:`._possible_shorts`      which cells may be shorts, and which others such shorts would disturb
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
