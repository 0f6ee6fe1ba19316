"""The scanned resistive grid with real parts: ohms to volts to counts.

``scan(Design.load("design.toml"), resistance)`` reads one frame.
"""

from ._adc import adc_codes, adc_error, clipped, volts_of_codes
from ._batch import BatchResult, scan_batch
from ._design import (
    CIRCUITS,
    Adc,
    Array,
    Cells,
    Design,
    Drive,
    Fault,
    Operation,
    Readout,
    Requirements,
    Sheet,
)
from ._effects import Effect, effects
from ._incremental import Scanner
from ._population import Boards, PopulationReading, scan_population
from ._readout import apparent_resistance, ideal_volts
from ._requirement import Conditions, Requirement
from ._scan import METHODS, ScanResult, scan
from ._sensitivity import Sensitivity, sensitivity
from ._spread import Spread
from .recovery._recover import Conditioning, Recoverer, Recovery, Status, conditioning, recover

__all__ = [
    "CIRCUITS",
    "METHODS",
    "Adc",
    "Array",
    "BatchResult",
    "Boards",
    "Cells",
    "Conditioning",
    "Conditions",
    "Design",
    "Drive",
    "Effect",
    "Fault",
    "Operation",
    "PopulationReading",
    "Readout",
    "Recoverer",
    "Recovery",
    "Requirement",
    "Requirements",
    "ScanResult",
    "Scanner",
    "Sensitivity",
    "Sheet",
    "Spread",
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
    "scan_population",
    "sensitivity",
    "volts_of_codes",
]
