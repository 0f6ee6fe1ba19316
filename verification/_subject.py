"""What all experiments work on: the design under verification, the cell, and where the board is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from ..bench._estimators import noisy
from ..cell import Cell, calibrate, checked_recording, protocol_load, sensitivity
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

    @cached_property
    def calibrated(self) -> Cell:
        """The cell as ``ohmskin fit`` finds it in a noisy recording of the calibration protocol.

        Takes some ten seconds, once: it is kept, and goes along when the subject is pickled.
        """
        return _calibrated(self.cell)

    @property
    def ours(self) -> str:
        """The best estimator of the calibrated cell beside the paper's."""
        found = self.calibrated.estimators
        assert found is not None  # it is calibrated
        others = {name: percent for name, percent in found.held_out_percent.items() if name != "paper"}
        return found.default if found.default in others else min(others, key=lambda name: others[name])


@cache
def _calibrated(cell: Cell) -> Cell:
    time_s, load = protocol_load(0.05)
    ohms = noisy(cell, load, 0.05, np.random.default_rng(0))
    recording = checked_recording(time_s, cell.full_scale_kpa * load, ohms, name="simulated protocol")
    return calibrate(recording, full_scale_kpa=cell.full_scale_kpa).cell
