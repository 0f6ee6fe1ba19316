"""Model of the scanned resistive grid with real parts: ohms to volts to ADC codes, and back (recovery).

``scan(Design.load("design.toml"), resistance)`` reads one frame.
"""

from ._adc import adc_codes, adc_error, at_ideal_converter, clipped, volts_of_codes
from ._amplifier_model import AmplifierModel
from ._board import Board
from ._design import Design
from ._effects import Effect, effects
from ._ideal import apparent_resistance, ideal_volts
from ._operating import OperatingPoint, operating_point, operating_points
from ._population import Boards, PopulationReading, read_together, scan_population
from ._readout import Readout
from ._requirement import Conditions, Requirement
from ._scan import METHODS, BatchResult, ScanResult, scan, scan_batch
from ._sections import Adc, Array, Cells, Drive, Fault, Operation, Requirements, Sheet
from ._sensitivity import Sensitivity, sensitivity
from ._shape import Shape
from ._spread import Spread
from .ends import ColumnEnd, Event, LineEnds, Reference, RowEnd, Scan
from .readouts import CIRCUITS as _CIRCUITS
from .recovery import (
    Conditioning,
    LiveRecovery,
    Readings,
    Reason,
    Recoverer,
    Recovery,
    Status,
    ValidityRule,
    conditioning,
    live_recovery,
    recover,
)
from .timing import (
    BoardsInTime,
    EventScan,
    Noise,
    Settling,
    Stability,
    Transient,
    noise,
    stability,
    stability_of_boards,
)

CIRCUITS: tuple[str, ...] = tuple(_CIRCUITS)
"""Readout circuits that a design file can name"""

__all__ = [
    "CIRCUITS",
    "METHODS",
    "Adc",
    "AmplifierModel",
    "Array",
    "BatchResult",
    "Board",
    "Boards",
    "BoardsInTime",
    "Cells",
    "ColumnEnd",
    "Conditioning",
    "Conditions",
    "Design",
    "Drive",
    "Effect",
    "Event",
    "EventScan",
    "Fault",
    "LineEnds",
    "LiveRecovery",
    "Noise",
    "OperatingPoint",
    "Operation",
    "PopulationReading",
    "Readings",
    "Readout",
    "Reason",
    "Recoverer",
    "Recovery",
    "Reference",
    "Requirement",
    "Requirements",
    "RowEnd",
    "Scan",
    "ScanResult",
    "Sensitivity",
    "Settling",
    "Shape",
    "Sheet",
    "Spread",
    "Stability",
    "Status",
    "Transient",
    "ValidityRule",
    "adc_codes",
    "adc_error",
    "apparent_resistance",
    "at_ideal_converter",
    "clipped",
    "conditioning",
    "effects",
    "ideal_volts",
    "live_recovery",
    "noise",
    "operating_point",
    "operating_points",
    "read_together",
    "recover",
    "scan",
    "scan_batch",
    "scan_population",
    "sensitivity",
    "stability",
    "stability_of_boards",
    "volts_of_codes",
]
