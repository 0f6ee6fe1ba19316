"""What all experiments work on: the design under verification, the cell, and where the board is."""

from __future__ import annotations

from dataclasses import dataclass

from ..cell import Cell
from ..cell.material import sensitivity
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
        change = sensitivity(self.cell.model, self.full_scale_kpa, self.rest)
        return self.rest * (1 + change)
