"""A quantity that a requirement may limit: how it is found, its unit and limits, what mends it, who checks it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

from ..circuits import Design, Requirement
from ._dut import DesignUnderTest
from ._hardware import Readings
from ._outcome import Measurement

NOMINAL: Final = "nominal"
WORST: Final = "worst-case"
SAMPLED: Final = "monte-carlo"
SPICE: Final = "spice"
HARDWARE: Final = "hardware"
SEARCHED = (WORST, NOMINAL, SAMPLED)
"""methods of a quantity that the worst-case search finds"""
SHARE_UNITS = ("% FS", "kPa")
"""in which a limit asks for an error as a share of full scale, whatever the cell"""
DOWN, UP = "down", "up"
"""directions in which a part may be changed"""
AVERAGING = "frames averaged"
Compute = Callable[[DesignUnderTest, Requirement, str], Measurement]
"""From the design under test, the requirement and the method to a measurement; raises NotRun or DoesNotApply."""
Limit = Callable[[Design], float | None]


@dataclass(frozen=True)
class Shipped:
    """A requirement that a design without requirements of its own is held to."""

    number: int
    """of its id, "D" and the number"""
    text: str
    min: Limit | float | None = None
    max: Limit | float | None = None
    method: Literal["monte-carlo", "spice"] | None = None
    applies: Callable[[Design], bool] = lambda design: True

    def requirement(self, quantity: str, design: Design) -> Requirement:
        """For a design."""
        low, high = (limit(design) if callable(limit) else limit for limit in (self.min, self.max))
        return Requirement(
            id=f"D{self.number}",
            quantity=quantity,
            text=self.text,
            source="shipped default",
            min=low,
            max=high,
            method=self.method,
        )


@dataclass(frozen=True)
class Quantity:
    """Something that can be found of a design."""

    name: str
    title: str
    unit: str
    says: str
    """what the number is, in one sentence"""
    compute: Compute
    methods: tuple[str, ...] = (WORST,)
    """the first is the default"""
    shipped: tuple[Shipped, ...] = ()
    mended_by: tuple[tuple[str, str], ...] = ()
    """parts that could keep a limit if they were changed alone, and in which direction"""
    rewired: bool = False
    """whether other idle lines or another circuit may mend it, too"""
    analysis: str = ""
    """of ngspice, that finds the same of nominal parts; empty: none does"""
    measured: Callable[[DesignUnderTest, Readings], Measurement] | None = None
    """the same from frames of a board; None: it cannot be measured"""
    units: tuple[str, ...] = ()
    """other units that a limit may be in, which say what is meant"""
    rates: tuple[str, str] | None = None
    """part and kind of the rating in ``[parts]`` that the quantity is held to, as ("driver", "current")"""
