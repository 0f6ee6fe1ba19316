"""The catalogue of quantities that a requirement may limit."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ..circuits import Requirement
from ..errors import InputError
from . import _chain as chain
from . import _dynamic as dynamic
from . import _self_test as self_test
from . import _static as static
from . import _stress as stress
from ._outcome import Measurement
from ._spice_check import spice_agreement
from ._subject import Subject

Compute = Callable[[Subject, Requirement, str], Measurement]
"""From the subject, the requirement and the method to a measurement; raises NotRun or DoesNotApply."""

NOMINAL, WORST, SAMPLED, SPICE, HARDWARE = "nominal", "worst-case", "monte-carlo", "spice", "hardware"


@dataclass(frozen=True)
class Quantity:
    """Something that can be found of a design."""

    name: str
    title: str
    unit: str
    compute: Compute
    methods: tuple[str, ...] = (WORST,)
    """the first is the default"""

    @property
    def says(self) -> str:
        """What the number is, in one sentence."""
        function = self.compute.func if isinstance(self.compute, partial) else self.compute
        return _SAYS.get(self.name) or (function.__doc__ or "").splitlines()[0]


_SAYS = {
    "crosstalk": "Largest change of an untouched cell's reading, of that reading, whatever other cells are pressed.",
    "reading_error": "Largest error of the resistance that the ideal circuit's law makes of an uncalibrated reading.",
    "gain_error": "Largest error of the change that is read when a cell alone goes from rest to full scale.",
}

_READING = (WORST, NOMINAL, SAMPLED)
CATALOGUE: dict[str, Quantity] = {
    quantity.name: quantity
    for quantity in (
        Quantity("crosstalk", "Crosstalk", "%", partial(static.reading_quantity, "crosstalk"), _READING),
        Quantity("reading_error", "Reading error", "%", partial(static.reading_quantity, "reading_error"), _READING),
        Quantity("gain_error", "Gain error", "%", partial(static.reading_quantity, "gain_error"), _READING),
        Quantity("output_headroom", "Headroom of the outputs", "V", static.output_headroom),
        Quantity("adc_headroom", "Headroom of the converter", "V", static.adc_headroom),
        Quantity("adc_range_used", "Converter range used", "%", static.adc_range_used, (NOMINAL,)),
        Quantity("resolution", "Resolution", "ohm", static.resolution, (NOMINAL,)),
        Quantity("noise", "Noise of a reading", "V", dynamic.reading_noise, (NOMINAL, SPICE)),
        Quantity("pressure_resolution", "Pressure resolution", "kPa", dynamic.pressure_resolution, (NOMINAL,)),
        Quantity("settling_error", "Settling error", "%", dynamic.settling_error, (WORST, SPICE)),
        Quantity("fastest_scan", "Fastest scan", "Hz", dynamic.fastest_scan),
        Quantity("phase_margin", "Phase margin", "°", dynamic.phase_margin, (WORST, SPICE)),
        Quantity("cell_voltage", "Voltage across a cell", "V", stress.cell_voltage),
        Quantity("cell_power", "Power in a cell", "W", stress.cell_power),
        Quantity("switch_current", "Current in a row switch", "A", stress.switch_current),
        Quantity("switch_power", "Power in a row switch", "W", stress.switch_power),
        Quantity("output_current", "Current of an output", "A", stress.output_current),
        Quantity("leakage_error", "Error by leakage of idle switches", "%", stress.leakage_error),
        Quantity("fault_coverage", "Fault coverage of a self-test", "%", self_test.fault_coverage),
        Quantity("pressure_rmse", "RMS error of the pressure", "% FS", chain.pressure_rmse),
        Quantity("pressure_peak_error", "Peak error of the pressure", "% FS", chain.pressure_peak_error),
        Quantity("lost_readings", "Readings lost to a limit", "%", chain.lost_readings),
        Quantity("valid_cells", "Cells that the driver can tell", "%", chain.valid_cells, (NOMINAL,)),
        Quantity("spice_agreement", "Agreement with ngspice", "%", spice_agreement, (NOMINAL,)),
        Quantity("latency", "Latency", "s", dynamic.latency),
        Quantity("lost_frames", "Frames lost on the line", "%", dynamic.lost_frames),
    )
}


def quantity_of(name: str) -> Quantity:
    """An entry of the catalogue. Raises InputError that names the nearest one."""
    if name not in CATALOGUE:
        near = difflib.get_close_matches(name, CATALOGUE, n=1, cutoff=0.0)
        raise InputError(
            f"no quantity '{name}'; the nearest is '{near[0]}', and a function of your own is 'FILE.py:FUNCTION'"
        )
    return CATALOGUE[name]
