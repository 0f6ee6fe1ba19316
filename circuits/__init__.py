"""The scanned resistive grid with real parts: ohms to volts to counts.

``scan(Design.load("design.toml"), resistance)`` reads one frame.
"""

from .adc import adc_codes, adc_error, clipped, volts_of_codes
from .design import CIRCUITS, Adc, Array, Design, Drive, Fault, Readout, Requirements, Sheet
from .effects import Effect, effects
from .readout import apparent_resistance, ideal_volts
from .recover import Conditioning, Recoverer, Recovery, Status, conditioning, recover
from .scan import ScanResult, scan
from .sensitivity import Sensitivity, sensitivity

__all__ = [
    "CIRCUITS",
    "Adc",
    "Array",
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
    "sensitivity",
    "volts_of_codes",
]
