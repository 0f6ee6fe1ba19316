"""The catalogue of quantities that a requirement may limit, in the order in which they are listed."""

from __future__ import annotations

import difflib

from ..errors import InputError
from ._quantity import Quantity
from .quantities import (
    adc_headroom,
    adc_range_used,
    cell_power,
    cell_voltage,
    crosstalk,
    fastest_scan,
    fault_coverage,
    gain_error,
    latency,
    leakage_error,
    lost_frames,
    lost_readings,
    noise,
    output_current,
    output_headroom,
    phase_margin,
    pressure_peak_error,
    pressure_resolution,
    pressure_rmse,
    reading_error,
    reference_power,
    reference_voltage,
    resolution,
    settling_error,
    spice_agreement,
    switch_current,
    switch_power,
    valid_cells,
)

CATALOGUE: dict[str, Quantity] = {
    module.QUANTITY.name: module.QUANTITY
    for module in (
        crosstalk,
        reading_error,
        gain_error,
        output_headroom,
        adc_headroom,
        adc_range_used,
        resolution,
        noise,
        pressure_resolution,
        settling_error,
        fastest_scan,
        phase_margin,
        cell_voltage,
        cell_power,
        switch_current,
        switch_power,
        output_current,
        reference_voltage,
        reference_power,
        leakage_error,
        fault_coverage,
        pressure_rmse,
        pressure_peak_error,
        lost_readings,
        valid_cells,
        spice_agreement,
        latency,
        lost_frames,
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
