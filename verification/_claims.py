"""The paper's claims P1 to P14, in their order."""

from __future__ import annotations

from . import _crosstalk as crosstalk
from . import _material as material
from . import _mixture as mixture
from . import _whole_skin as skin

STATEMENTS = (
    mixture.fraction,
    *(material.electrodes, material.strain, material.rising, material.recovery, material.identification),
    *(material.recovery_times, material.inverse_filter, material.steps),
    *(crosstalk.slicing, crosstalk.grid_resistance, crosstalk.equation_10, crosstalk.crosstalk),
    skin.whole_skin,
)
