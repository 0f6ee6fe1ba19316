"""Inverse problem of a resistive array: from readings back to cells, with an error bound for each cell.

============================  =====================================================================================
:mod:`._recover`              one frame, to the last digits: the live recovery behind very fine steps
:mod:`._recovered`            its result: resistances, status, uncertainties
:mod:`._conditioning`         propagation of errors from the readings to the cells
============================  =====================================================================================

A stream, in bounded time per frame, begins with :func:`live_recovery` in :mod:`._live`, and gives a
:class:`.Measurement` for each frame (:mod:`._measured`): conductances, uncertainties, reasons. Boards whose circuit
states what a reading says of its own conductance and of its column (:meth:`..readouts.ReadoutCircuit.port_law`):

============================  =====================================================================================
:mod:`._live_law`             the stages of a frame
:mod:`._law_frames`           a frame in one kernel, with factors that hold
:mod:`._law`                  cells by Kirchhoff's laws of columns and rows, in closed form (:mod:`._law_kernels`)
:mod:`._factors`              everything beyond these laws, as one factor for each cell
:mod:`._enclosure`            cells beside others whose readings do not determine them
:mod:`._known_board`          what is known of a board before anything is read
:mod:`._answers`              bounds on all answers, where readings may have several
============================  =====================================================================================

Single frames that the laws leave open, boards with bridged lines, and dividers with floating rows, where all cells take
part in every reading: :mod:`._live_fit`, with :mod:`._usual_fits` for most frames, :mod:`._node_blocks` and
:mod:`._port_derivatives` on large arrays, and :mod:`._sheet_model` for a continuous sheet. The model of both is
:mod:`._quick_model`, with the shared wire of a line's cells by :mod:`._lines`.
"""

from ._conditioning import Conditioning, conditioning
from ._live import live_recovery
from ._live_reading import LiveRecovery, Readings, Reason, ValidityRule
from ._recover import Recoverer, recover
from ._recovered import Recovery, Status

__all__ = [
    "Conditioning",
    "LiveRecovery",
    "Readings",
    "Reason",
    "Recoverer",
    "Recovery",
    "Status",
    "ValidityRule",
    "conditioning",
    "live_recovery",
    "recover",
]
