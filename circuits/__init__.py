"""The scanned resistive grid with real parts: ohms to volts to counts.

``scan(Design.load("design.toml"), resistance)`` reads one frame.
"""

from .adc import adc_codes, adc_error, clipped, volts_of_codes
from .batch import BatchResult, scan_batch
from .design import CIRCUITS, Adc, Array, Design, Drive, Fault, Readout, Requirements, Sheet
from .effects import Effect, effects
from .incremental import Scanner
from .readout import apparent_resistance, ideal_volts
from .recover import Conditioning, Recoverer, Recovery, Status, conditioning, recover
from .scan import METHODS, ScanResult, scan
from .sensitivity import Sensitivity, sensitivity

__all__ = [
    "CIRCUITS",
    "METHODS",
    "Adc",
    "Array",
    "BatchResult",
    "Conditioning",
    "Design",
    "Drive",
    "Effect",
    "Fault",
    "Readout",
    "Recoverer",
    "Recovery",
    "Requirements",
    "ScanResult",
    "Scanner",
    "Sensitivity",
    "Sheet",
    "Status",
    "adc_codes",
    "adc_error",
    "apparent_resistance",
    "clipped",
    "conditioning",
    "effects",
    "ideal_volts",
    "recover",
    "scan",
    "scan_batch",
    "sensitivity",
    "volts_of_codes",
]
