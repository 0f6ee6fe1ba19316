"""The scanned resistive grid with real parts: ohms to volts to counts.

``scan(Design.load("design.toml"), resistance)`` reads one frame.
"""

from ._adc import adc_codes, adc_error, clipped, volts_of_codes
from ._batch import BatchResult, scan_batch
from ._board import Board
from ._design import Adc, Array, Design, Drive, Fault, Readout, Requirements, Sheet
from ._effects import Effect, effects
from ._ideal import apparent_resistance, ideal_volts
from ._scan import METHODS, ScanResult, scan
from ._sensitivity import Sensitivity, sensitivity
from .readouts import CIRCUITS as _CIRCUITS
from .recovery import Conditioning, Recoverer, Recovery, Status, conditioning, recover
from .timing import Noise, Settling, Stability, noise, stability

CIRCUITS: tuple[str, ...] = tuple(_CIRCUITS)
"""Readout circuits that a design file can name"""

__all__ = [
    "CIRCUITS",
    "METHODS",
    "Adc",
    "Array",
    "BatchResult",
    "Board",
    "Conditioning",
    "Design",
    "Drive",
    "Effect",
    "Fault",
    "Noise",
    "Readout",
    "Recoverer",
    "Recovery",
    "Requirements",
    "ScanResult",
    "Sensitivity",
    "Settling",
    "Sheet",
    "Stability",
    "Status",
    "adc_codes",
    "adc_error",
    "apparent_resistance",
    "clipped",
    "conditioning",
    "effects",
    "ideal_volts",
    "noise",
    "recover",
    "scan",
    "scan_batch",
    "sensitivity",
    "stability",
    "volts_of_codes",
]
