"""What all experiments work on: the design under verification, the cell, and where the board is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..cell import Cell
from ..circuits import Design


@dataclass(frozen=True)
class Subject:
    """Design, cell and target of one verification run."""

    design: Design
    cell: Cell
    target: str = "emulated"

    @property
    def rest(self) -> float:
        """ohm of an untouched cell"""
        return self.cell.rest_resistance_ohm

    @property
    def full_scale_kpa(self) -> float:
        return self.cell.full_scale_kpa

    @property
    def pressed(self) -> float:
        """ohm at equilibrium under full scale"""
        forward = self.cell.forward((1,))
        forward.step(1.0, np.array([self.full_scale_kpa]))
        return float(forward.step(1e6, np.array([self.full_scale_kpa]))[0])
