"""What errors of settled readings have in common: worst case, nominal parts and yield."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from ..circuits import Requirement
from ._dut import DesignUnderTest, once
from ._judging import contributions, corner_of, in_both_units, maps, measured, worst_of
from ._montecarlo import CONFIDENCE, Sampler, blocks, boards_needed, proportion_bounds
from ._outcome import Measurement
from ._quantity import NOMINAL, SAMPLED, WORST
from ._readings import ReadingErrorTarget
from ._units import engineering

METHODS = (WORST, NOMINAL, SAMPLED)
UNITS = ("% FS", "kPa")
"""in which a limit asks for the error as a share of full scale, whatever the cell"""


def judged_by(requirement: Requirement) -> bool | None:
    """Whether a requirement asks for shares of full scale; None: as the cell has it."""
    return True if requirement.unit in UNITS else None


def judge(target: ReadingErrorTarget, dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    """One error, of resistance in % or as a share of full scale."""
    share = judged_by(requirement)
    if method == SAMPLED:
        return _yield(target, dut, requirement, share)
    found = worst_of(dut, target, spread=method == WORST, share=share)
    unit = found.box.scale.unit
    if not np.isfinite(found.value):
        lost = "a reading at or beyond an end of the circuit's law or of the converter, or an output at its limit"
        where = f"{found.where}: {lost}"
        return Measurement(inf, unit, where=where, confidence=found.search, corner=corner_of(found))
    return replace(
        measured(found, 100 * found.value, unit),
        text=[in_both_units(dut, found)],
        contributions=contributions(found, 100.0) if method == WORST else {},
        figures=maps(found, unit, requirement.max),
    )


@once
def sampler_of(dut: DesignUnderTest, target: ReadingErrorTarget, share: bool | None) -> Sampler:
    """What judges random boards."""
    return Sampler.of(worst_of(dut, target, share=share))


@once
def samples_of(dut: DesignUnderTest, target: ReadingErrorTarget, share: bool | None) -> np.ndarray:
    """(boards,) the values of the Monte Carlo analysis, of 1."""
    sampler = sampler_of(dut, target, share)
    return np.concatenate([sampler.block(dut.seed, block) for block in range(blocks(dut.samples))])


def _yield(
    target: ReadingErrorTarget, dut: DesignUnderTest, requirement: Requirement, share: bool | None
) -> Measurement:
    """How many boards keep the limits."""
    values = 100 * samples_of(dut, target, share)[: dut.samples]
    unit = sampler_of(dut, target, share).box.scale.unit
    low, high = requirement.min, requirement.max
    kept = np.isfinite(values)
    kept &= (values >= low) if low is not None else True
    kept &= (values <= high) if high is not None else True
    count, good = len(values), int(kept.sum())
    wanted = requirement.conditions.yield_percent / 100
    bounds = proportion_bounds(good, count)
    quantile = float(np.sort(values)[min(int(np.ceil(wanted * count)) - 1, count - 1)])
    worst = int(np.argmax(values))
    return Measurement(
        quantile,
        unit,
        where=f"board {worst} of seed {dut.seed} is the worst: {engineering(float(values[worst]), unit)}",
        confidence=(
            f"{good} of {count} boards keep the limit: yield {100 * good / count:.4g} %, "
            f"{100 * bounds[0]:.4g} to {100 * bounds[1]:.4g} % "
            f"({100 * CONFIDENCE:.0f} % confidence, Clopper-Pearson); wanted {100 * wanted:.4g} %"
        ),
        text=[
            f"The value shown is the {100 * wanted:.4g} % quantile of the boards.",
            "Each board is judged as the worst case is: its worst cell, with the presses that derivatives and the "
            "worst-case search name for it.",
        ],
        samples=tuple(values.tolist()),
        proven=bounds[0] >= wanted,
        undecided=_more_boards(good, count, wanted) if bounds[0] < wanted <= good / count else "",
    )


def _more_boards(good: int, count: int, wanted: float) -> str:
    """Why the yield is neither proven nor missed, and how many boards would decide."""
    needed = boards_needed(wanted, good / count)
    more = "no number of boards" if needed is None else f"--samples {max(needed, count + 1)}"
    return (
        f"{good} of {count} boards keep the limit, too few to prove a yield of {100 * wanted:.4g} %: "
        f"{more} would, if as large a share keeps it"
    )
