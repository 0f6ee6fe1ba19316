"""The design under test: what all requirements and claims are judged on, with its cells and its board."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from ..cell import Cell, ContactModel, PaperModel, rehearsed
from ..circuits import Adc, Boards, Design, scan_population
from ..common.arrays import FloatArray
from ._outcome import NotRun
from ._parameters import NOMINAL_K, Factors
from ._scale import DECADE, Scale, ShareScale

SAMPLES = 1000
SEED = 1
P = ParamSpec("P")
T = TypeVar("T")


def everything_of(design: Design) -> dict[str, Any]:
    """All values of a design that a number can depend on, those included that boards do not send."""
    tables: dict[str, Any] = design.model_dump(exclude_defaults=True)
    model = design.readout.amplifier_model
    if model is not None:
        tables["readout"]["amplifier_model"] = {**model.model_dump(exclude={"file"}), "text": model.text}
    return tables


@dataclass(frozen=True)
class DesignUnderTest:
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
    compares: bool = True
    """whether worst cases are explained and put beside other analyses; an exploration needs them alone"""
    _found: dict[Any, Any] = field(default_factory=dict, init=False, compare=False, repr=False)
    """results of functions that are :func:`once`"""

    def __getstate__(self) -> dict[str, Any]:
        """Intermediate results stay in the process that worked them out."""
        return {each.name: getattr(self, each.name) for each in fields(self)} | {"_found": {}}

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

    def with_design(self, design: Design) -> DesignUnderTest:
        """The same with another design."""
        return replace(self, design=design)

    def at_rate(self, frame_rate: float) -> DesignUnderTest:
        """The same with a frame rate, where the design states none."""
        if self.design.operation.frame_rate is not None:
            return self
        return self.with_design(self.design.replace(operation={"frame_rate": frame_rate}))

    @cached_property
    def hot(self) -> Design:
        """The design at its hottest: for noise, whose temperature the ambient one stands in for."""
        kelvin = self.design.operation.temperature_range
        if self.design.readout.temperature or kelvin is None:
            return self.design
        return self.design.replace(readout={"temperature": kelvin[1]})

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

    @property
    def uniform(self) -> dict[str, FloatArray]:
        """Two frames (rows, columns) in ohm, by what all cells are."""
        shape = self.design.array.shape
        return {"at rest": np.full(shape, self.rest), "at full scale": np.full(shape, self.pressed)}

    @cached_property
    def nominal(self) -> dict[str, FloatArray]:
        """V (rows, columns) that nominal boards read of the frames :attr:`uniform`."""
        frames = self.uniform
        volts = scan_population(self.design, Boards.of(self.design), np.stack(list(frames.values()))).volts
        return dict(zip(frames, volts, strict=True))

    def converter(self) -> Adc:
        """Raises NotRun where the design has none."""
        if self.design.adc is None:
            raise NotRun("missing: adc.bits, adc.range")
        return self.design.adc

    @cached_property
    def cell_spread(self) -> float:
        """Largest relative deviation of a cell's resistance from that of the nominal cell, with temperature and age."""
        return self.cell_spread_at(aged=True)

    def cell_spread_at(self, *, aged: bool) -> float:
        """As :attr:`cell_spread`, at the end of the cells' life or of new ones."""
        spread = self.design.spreads.get("cells.rest_resistance")
        if spread is None:
            return 0.0
        ageing = spread.ageing if aged else (0.0, 0.0)
        width = spread.tolerance + ageing[0] + (spread.deviation + ageing[1]) / self.rest
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
    def share_scale(self) -> ShareScale:
        """Errors as shares of full scale."""
        return ShareScale.of_cell(self.cell, self.pressed, knows_pressure=self.knows_pressure)

    @property
    def scale(self) -> Scale:
        """What errors of readings are judged in: resistance, or full scale where that spans more than a decade."""
        low, high = sorted((self.rest, self.pressed))
        return self.share_scale if high > DECADE * low or self.cell.open_at_rest else Scale()

    @cached_property
    def factors(self) -> Factors:
        """Of all parts at the end of their lives."""
        return Factors.of(self.design)

    @property
    def calibrated(self) -> Cell:
        """The cell as ``ohmskin fit`` finds it in a noisy recording of the calibration protocol, worked out once."""
        return _calibrated(self.cell)

    @property
    def ours(self) -> str:
        """The best estimator of the calibrated cell beside the paper's."""
        found = self.calibrated.estimators
        assert found is not None  # it is calibrated
        others = {name: percent for name, percent in found.held_out_percent.items() if name != "paper"}
        return found.default if found.default in others else min(others, key=lambda name: others[name])


def once(
    function: Callable[Concatenate[DesignUnderTest, P], T],
) -> Callable[Concatenate[DesignUnderTest, P], T]:
    """A function of a design under test and hashable arguments that is worked out once for each of them.

    The result is kept with the design under test, so that requirements share it in whatever order they are judged.
    """

    signature = inspect.signature(function)

    @wraps(function)
    def kept(dut: DesignUnderTest, /, *args: P.args, **options: P.kwargs) -> T:
        given = signature.bind(dut, *args, **options)
        given.apply_defaults()
        key = (function, *list(given.arguments.values())[1:])
        if key not in dut._found:
            dut._found[key] = function(dut, *args, **options)
        found: T = dut._found[key]
        return found

    return kept


@cache
def _calibrated(cell: Cell) -> Cell:
    return rehearsed(cell)
