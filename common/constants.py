"""Constants of nature that the SI has fixed (2019): exact numbers, without the tenth of a second that SciPy's take."""

from __future__ import annotations

BOLTZMANN = 1.380649e-23
"""J/K"""
ELEMENTARY_CHARGE = 1.602176634e-19
"""C"""
ZERO_CELSIUS = 273.15
"""K"""
