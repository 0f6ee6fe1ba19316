"""The catalogue of quantities that a requirement may limit, in the order in which they are listed."""

from __future__ import annotations

import difflib

from ..errors import InputError
from ._quantity import Quantity
from .quantities import (
    converter,
    fault_coverage,
    headroom,
    noise,
    presses,
    reading_errors,
    settling,
    spice_agreement,
    stress,
    transfer,
    valid_cells,
)

_FAMILIES = (
    *(reading_errors.QUANTITIES, headroom.QUANTITIES, converter.QUANTITIES, noise.QUANTITIES, settling.QUANTITIES),
    *(stress.QUANTITIES, fault_coverage.QUANTITIES, presses.QUANTITIES, valid_cells.QUANTITIES),
    *(spice_agreement.QUANTITIES, transfer.QUANTITIES),
)
CATALOGUE: dict[str, Quantity] = {quantity.name: quantity for family in _FAMILIES for quantity in family}


def quantity_of(name: str) -> Quantity:
    """An entry of the catalogue. Raises InputError that names the nearest one."""
    if name not in CATALOGUE:
        near = difflib.get_close_matches(name, CATALOGUE, n=1, cutoff=0.0)
        raise InputError(
            f"no quantity '{name}'; the nearest is '{near[0]}', and a function of your own is 'FILE.py:FUNCTION'"
        )
    return CATALOGUE[name]
