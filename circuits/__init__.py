"""The scanned resistive grid with real parts: ohms to volts to counts.

``scan(Design.load("design.toml"), resistance)`` reads one frame.
"""

from .adc import adc_codes, clipped, volts_of_codes
from .design import Adc, Array, Design, Drive, Readout, Requirements
from .readout import apparent_resistance, ideal_volts
from .scan import ScanResult, scan

__all__ = [
    "Adc",
    "Array",
    "Design",
    "Drive",
    "Readout",
    "Requirements",
    "ScanResult",
    "adc_codes",
    "apparent_resistance",
    "clipped",
    "ideal_volts",
    "scan",
    "volts_of_codes",
]
