"""Engineering notation: ``23500`` ohm is shown as ``23.5 kΩ``; and conversion between the units of limits."""

from __future__ import annotations

import math

from ..errors import InputError

PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
PREFIXED = {"V": "V", "A": "A", "ohm": "Ω", "Ω": "Ω", "F": "F", "Hz": "Hz", "s": "s", "W": "W", "m": "m"}
PREFIXED |= {"V/sqrt(Hz)": "V/√Hz", "A/sqrt(Hz)": "A/√Hz", "S": "S"}
"""Units that take a prefix, and how each is written."""
FACTORS = {"f": 1e-15, "p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}


UNITS = {
    "array": {"row_segment": "ohm", "column_segment": "ohm", "row_lead": "ohm", "column_lead": "ohm"},
    "drive": {"voltage": "V", "idle_leakage": "A"},
    "readout": {
        "reference_resistance": "ohm",
        "reference_voltage": "V",
        "gain_bandwidth": "Hz",
        "offset_voltage": "V",
        "bias_current": "A",
        "supply": "V",
        "column_capacitance": "F",
        "feedback_capacitance": "F",
        "voltage_noise": "V/sqrt(Hz)",
        "current_noise": "A/sqrt(Hz)",
        "temperature": "K",
    },
    "adc": {
        "bits": "bit",
        "range": "V",
        "sampling_capacitance": "F",
        "switch_resistance": "ohm",
        "acquisition_time": "s",
        "offset_voltage": "V",
        "inl_steps": "steps",
    },
    "sheet": {"pitch": "m", "thickness": "m", "electrode_width": "m"},
    "cells": {"rest_resistance": "ohm", "full_scale_resistance": "ohm", "full_scale_kpa": "kPa"},
    "operation": {
        "frame_rate": "Hz",
        "baudrate": "bit/s",
        "temperature_range": "K",
        "readings_per_calibration": "frames",
    },
    "requirements": {"crosstalk_percent": "%", "reading_error_percent": "%", "pressure_rmse_percent": "%"}
    | {"output_current": "A", "driver_current": "A"},
}
"""Units of the keys of DESIGN.toml; keys without one have none."""
LEAST_SHOWN = 1e-9
"""A smaller number of a unit without prefixes is rounding, and shown as less than this."""
LEAST_PREFIXED = 1e-18
_LARGEST_IN_FULL = 1e9


def engineering(value: float, unit: str = "", digits: int = 4) -> str:
    """A number with its unit, the exponent a multiple of three where the unit takes a prefix."""
    if math.isnan(value):
        return "no number"
    if math.isinf(value):
        return ("−" if value < 0 else "") + "∞" + (f" {unit}" if unit else "")
    if unit not in PREFIXED:
        if 0 < abs(value) < LEAST_SHOWN and unit:
            return f"< {_powers(LEAST_SHOWN, 1)} {unit}" if value > 0 else f"> −{_powers(LEAST_SHOWN, 1)} {unit}"
        return f"{_powers(value, digits)} {unit}".rstrip()
    if value == 0:
        return f"0 {PREFIXED[unit]}"
    if abs(value) < LEAST_PREFIXED:
        least = f"0.001 {PREFIXES[-15]}{PREFIXED[unit]}"
        return f"< {least}" if value > 0 else f"> −{least}"
    exponent = 3 * math.floor(math.log10(abs(value)) / 3 + 1e-12)
    exponent = min(max(exponent, min(PREFIXES)), max(PREFIXES))
    shown = f"{value / 10.0**exponent:.{digits}g}"
    if "e" in shown:
        shown = f"{value / 10.0**exponent:.0f}" if abs(value) >= 1 else f"{value:.{digits}g}"
    return f"{_minus(shown)} {PREFIXES[exponent]}{PREFIXED[unit]}"


def _powers(value: float, digits: int) -> str:
    """A number without a prefix: in full, or times a power of ten that is a multiple of three."""
    shown = f"{value:.{digits}g}"
    if "e" not in shown:
        return _minus(shown)
    if 1 <= abs(value) < _LARGEST_IN_FULL:
        return _minus(f"{value:.0f}")
    exponent = 3 * math.floor(math.log10(abs(value)) / 3 + 1e-12)
    power = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{_minus(f'{value / 10.0**exponent:.{digits}g}')}·10{power}"


def conversion(given: str, wanted: str) -> float:
    """The factor from unit ``given`` to unit ``wanted``: from mV to V, 1e-3.

    Raises:
        InputError: the units do not measure the same.
    """
    if given in ("", wanted):
        return 1.0
    plain = {"Ω": "ohm", "degrees": "°", "deg": "°"}
    given, wanted = plain.get(given, given), plain.get(wanted, wanted)
    if given == wanted:
        return 1.0
    special = {("kPa", "Pa"): 1e3, ("Pa", "kPa"): 1e-3, ("%", ""): 0.01, ("", "%"): 100.0}
    if (given, wanted) in special:
        return special[given, wanted]
    if given[:1] in FACTORS and given[1:] == wanted:
        return FACTORS[given[0]]
    raise InputError(
        f"unit '{given}' does not fit; expected '{wanted}'" if wanted else f"unit '{given}' is not expected"
    )


def _minus(shown: str) -> str:
    return shown.replace("-", "−") if shown.startswith("-") else shown
