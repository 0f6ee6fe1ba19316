"""How long a run will take: points that its searches and samples will solve, times what one takes here and now."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from ..circuits import Requirement
from ..errors import OhmskinError
from ._box import Box, Corners
from ._catalogue import CATALOGUE
from ._dut import DesignUnderTest
from ._judging import Searched, box_of, judged_by
from ._montecarlo import blocks, blocks_beside
from ._outcome import DoesNotApply, NotRun
from ._quantity import NOMINAL, SAMPLED
from ._search import Target, expected_points
from ._tuning import BLOCK, TIMED_CELLS, TIMED_FEWEST, TIMED_MOST, TOGETHER


def expected_seconds(dut: DesignUnderTest, requirements: Sequence[Requirement]) -> float:
    """s of processor time of all searches and samples; presses in time, ngspice and pictures are not among them."""
    points: dict[tuple[Target, bool | None], float] = {}
    for requirement in requirements:
        quantity = CATALOGUE.get(requirement.quantity)
        if quantity is None or not isinstance(quantity.compute, Searched):
            continue
        try:
            target = quantity.compute.target(dut, requirement)
        except (NotRun, DoesNotApply, OhmskinError):
            continue
        if isinstance(target, Target):
            key = target, judged_by(requirement)
            points[key] = points.get(key, 0.0) + _points(dut, target, requirement, searched=key in points)
    seconds = 0.0
    for (target, share), count in points.items():
        try:
            seconds += count * _seconds_of_a_point(target, box_of(dut, share=share))
        except OhmskinError:  # the search will say why
            continue
    return seconds


def _points(dut: DesignUnderTest, target: Target, requirement: Requirement, *, searched: bool) -> float:
    """Points of one requirement, without the search where another one has it."""
    box = box_of(dut, "nominal" if requirement.method == NOMINAL else "aged")
    search = 0.0 if searched else expected_points(target, box) * (2.0 if dut.design.ages else 1.0)
    if requirement.method == NOMINAL:
        return search
    tries = 2 * TOGETHER if target.by_cell else 2
    drawn = blocks(dut.samples) if requirement.method == SAMPLED else blocks_beside(target, box, tries, dut.samples)
    return search + BLOCK * drawn * tries


def _seconds_of_a_point(target: Target, box: Box) -> float:
    count = int(np.clip(TIMED_CELLS / target.cost(box), TIMED_FEWEST, TIMED_MOST))
    x = np.random.default_rng(0).choice([-1.0, 1.0], (count, box.size))
    target.evaluate(box, Corners.of_boards(x[:1]))  # what is made only once is no part of it
    start = time.process_time()
    target.evaluate(box, Corners.of_boards(x))
    return (time.process_time() - start) / count
