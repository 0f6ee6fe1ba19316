"""The catalogue of quantities that a requirement may limit, in the order in which they are listed."""

from __future__ import annotations

import difflib

from ..errors import InputError
from ._quantity import Quantity
from .quantities import (
    adc_headroom,
    adc_range_used,
    crosstalk,
    fastest_scan,
    fault_coverage,
    gain_error,
    latency,
    leakage_error,
    lost_frames,
    lost_readings,
    noise,
    output_headroom,
    phase_margin,
    pressure_peak_error,
    pressure_resolution,
    pressure_rmse,
    reading_error,
    resolution,
    settling_error,
    spice_agreement,
    stress,
    valid_cells,
)

CATALOGUE: dict[str, Quantity] = {
    quantity.name: quantity
    for quantity in (
        crosstalk.QUANTITY,
        reading_error.QUANTITY,
        gain_error.QUANTITY,
        output_headroom.QUANTITY,
        adc_headroom.QUANTITY,
        adc_range_used.QUANTITY,
        resolution.QUANTITY,
        noise.QUANTITY,
        pressure_resolution.QUANTITY,
        settling_error.QUANTITY,
        fastest_scan.QUANTITY,
        phase_margin.QUANTITY,
        *stress.QUANTITIES,
        leakage_error.QUANTITY,
        fault_coverage.QUANTITY,
        pressure_rmse.QUANTITY,
        pressure_peak_error.QUANTITY,
        lost_readings.QUANTITY,
        valid_cells.QUANTITY,
        spice_agreement.QUANTITY,
        latency.QUANTITY,
        lost_frames.QUANTITY,
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
