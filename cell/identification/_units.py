"""Units as people write them in headers: ``Load (lbf)``, ``force_N``, ``time_ms``, ``Resistance [kOhm]``, ``R/Ω``."""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

Quantity = Literal["time", "force", "pressure", "resistance", "conductance", "voltage", "counts"]


class Unit(NamedTuple):
    """A unit of a quantity."""

    quantity: Quantity
    factor: float
    """to s, N, kPa, ohm, S, V or counts"""
    name: str


_UNITS: dict[Quantity, dict[str, float]] = {
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0},
    "force": {
        **{"N": 1.0, "newton": 1.0, "newtons": 1.0, "mN": 1e-3, "kN": 1e3},
        **{"lbf": 4.4482216, "lb": 4.4482216, "lbs": 4.4482216, "ozf": 0.27801385},
        **{"kgf": 9.80665, "kg": 9.80665, "g": 9.80665e-3, "gf": 9.80665e-3, "grams": 9.80665e-3},
    },
    "pressure": {
        **{"kPa": 1.0, "Pa": 1e-3, "hPa": 0.1, "mbar": 0.1, "bar": 100.0, "MPa": 1e3, "psi": 6.894757},
        **{"N/mm2": 1e3, "N/mm^2": 1e3, "N/cm2": 10.0, "N/cm^2": 10.0, "mmHg": 0.1333224},
    },
    "resistance": {
        **{"ohm": 1.0, "ohms": 1.0, "\N{GREEK CAPITAL LETTER OMEGA}": 1.0, "\N{OHM SIGN}": 1.0},
        **{"kohm": 1e3, "kohms": 1e3, "k\N{GREEK CAPITAL LETTER OMEGA}": 1e3, "k\N{OHM SIGN}": 1e3},
        **{"Mohm": 1e6, "Mohms": 1e6, "M\N{GREEK CAPITAL LETTER OMEGA}": 1e6, "M\N{OHM SIGN}": 1e6},
        **{"mohm": 1e-3, "Gohm": 1e9},
    },
    "conductance": {"S": 1.0, "mS": 1e-3, "uS": 1e-6, "µS": 1e-6, "nS": 1e-9},
    "voltage": {"V": 1.0, "volt": 1.0, "volts": 1.0, "mV": 1e-3, "uV": 1e-6},
    "counts": {"counts": 1.0, "count": 1.0, "adc": 1.0, "raw": 1.0, "lsb": 1.0},
}
_EXACT = {text: Unit(quantity, factor, text) for quantity, of in _UNITS.items() for text, factor in of.items()}
_WITHOUT_CASE: dict[str, list[Unit]] = {}
for _text, _unit in _EXACT.items():
    _WITHOUT_CASE.setdefault(_text.lower(), []).append(_unit)
_BRACKETED = re.compile(r"^(.*?)\s*[\(\[]\s*([^()\[\]]+?)\s*[\)\]]\s*$")
_LAST_WORD = re.compile(r"^(.*?)[\s_/,:-]+([^\s_,:()\[\]]+)$")


def unit_named(text: str) -> Unit | None:
    """The unit of this name; None: no unit. Case decides where it matters (mN, MN); else it is ignored (KOHM)."""
    found = _EXACT.get(text.strip())
    if found is not None:
        return found
    alike = _WITHOUT_CASE.get(text.strip().lower(), [])
    return alike[0] if len({(unit.quantity, unit.factor) for unit in alike}) == 1 else None


def header_unit(header: str) -> tuple[str, Unit | None]:
    """The name in a header without its unit, and the unit; None: it states none.

    The unit stands in brackets, or is the last word: after a space, an underscore or a slash.
    """
    for pattern in (_BRACKETED, _LAST_WORD):
        parts = pattern.match(header.strip())
        unit = unit_named(parts[2]) if parts else None
        if parts and unit is not None:
            return parts[1].strip(" _/"), unit
    return header.strip(), None
