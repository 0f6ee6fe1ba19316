"""What all experiments work on: the design under verification, its cells, and where the board is."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from ..bench import noisy
from ..cell import Cell, ContactModel, PaperModel, calibrate, checked_recording, protocol_load
from ..circuits import Design
from ..common.arrays import FloatArray
from ._parameters import NOMINAL_K, Factors

SAMPLES = 1000
SEED = 1


def everything_of(design: Design) -> dict[str, Any]:
    """All values of a design that a number can depend on, those included that boards do not send."""
    tables: dict[str, Any] = design.model_dump(exclude_defaults=True)
    model = design.readout.amplifier_model
    if model is not None:
        tables["readout"]["amplifier_model"] = {**model.model_dump(exclude={"file"}), "text": model.text}
    return tables


@dataclass(frozen=True)
class Subject:
    """Design, cell and target of one verification run."""

    design: Design
    given_cell: Cell | None = None
    """of ``--cell``; None: the design's [cells], or the shipped example cell"""
    target: str = "emulated"
    seed: int = SEED
    samples: int = SAMPLES
    """boards of the Monte Carlo analysis"""
    jig: FloatArray | None = field(default=None, compare=False)
    """(rows, columns) ohm of known resistors on the board, if there are any"""
    board: str = "ohmskin"
    """family of the board at a port, or its BOARD.toml"""
    baud: int | None = None
    """baud rate of the port; None: that of the board"""
    memo: dict[Hashable, Any] = field(default_factory=dict, compare=False, repr=False)
    """intermediate results that several requirements share"""

    def __getstate__(self) -> dict[str, Any]:
        """Intermediate results stay in the process that worked them out."""
        return {name: value for name, value in self.__dict__.items() if name != "factors"} | {"memo": {}}

    @cached_property
    def cell(self) -> Cell:
        """The cell with its memory: as given, or the example cell scaled to the resistances of the design."""
        stated = self.design.cells
        if self.given_cell is not None:
            return self.given_cell
        example = Cell.example()
        if stated is None:
            return example
        full = stated.full_scale_kpa or example.full_scale_kpa
        change = stated.full_scale_resistance / stated.rest_resistance - 1
        if change < 0:
            beside = 1 / (1 / stated.full_scale_resistance - 1 / stated.rest_resistance)
            model: Any = ContactModel(full_scale_resistance_ohm=beside)
        else:
            assert isinstance(example.model, PaperModel)
            softer = example.model.gain_per_kpa * full / change
            keys = ("eu1_kpa", "etau2_kpa", "eu2_kpa_per_s", "e1_kpa", "e2_kpa", "e3_kpa", "eta2_kpa_s", "eta3_kpa_s")
            model = example.model.replace(**{key: getattr(example.model, key) * softer for key in keys})
        return Cell(rest_resistance_ohm=stated.rest_resistance, full_scale_kpa=full, model=model)

    def at_rate(self, frame_rate: float) -> Subject:
        """The same with a frame rate, where the design states none."""
        if self.design.operation.frame_rate is not None:
            return self
        stated = self.design.replace(operation={"frame_rate": frame_rate})
        return replace(self, design=stated, memo={})

    @property
    def cell_source(self) -> str:
        """Where the resistances of the cells come from."""
        if self.given_cell is not None:
            return "CELL.toml"
        if self.design.cells is not None:
            return "[cells] of the design, with the memory of the shipped example cell"
        return "the shipped example cell: its values are the project's own"

    @property
    def knows_pressure(self) -> bool:
        """Whether a full scale in kPa is given, or no cell at all and the example stands in."""
        stated = self.design.cells
        return self.given_cell is not None or stated is None or stated.full_scale_kpa is not None

    @property
    def rest(self) -> float:
        """ohm of an untouched cell"""
        return self.cell.rest_resistance_ohm

    @property
    def full_scale_kpa(self) -> float:
        return self.cell.full_scale_kpa

    @cached_property
    def pressed(self) -> float:
        """ohm at equilibrium under full scale"""
        return float(self.cell.equilibrium_ohm(1.0))

    @cached_property
    def cell_spread(self) -> float:
        """Largest relative deviation of a cell's resistance from that of the nominal cell, temperature included."""
        spread = self.design.spreads.get("cells.rest_resistance")
        if spread is None:
            return 0.0
        width = spread.tolerance + spread.deviation / self.rest
        if self.design.operation.temperature_range is not None:
            extremes = (abs(kelvin - NOMINAL_K) for kelvin in self.design.operation.temperature_range)
            width += abs(spread.temperature_coefficient) * max(extremes)
        return float(width)

    @property
    def extremes(self) -> tuple[float, float]:
        """ohm: the least and the largest resistance that any cell takes"""
        low, high = sorted((self.rest, self.pressed))
        return low * (1 - min(self.cell_spread, 0.999)), high * (1 + self.cell_spread)

    @cached_property
    def factors(self) -> Factors:
        return Factors.of(self.design)

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
