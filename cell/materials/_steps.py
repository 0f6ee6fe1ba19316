"""Exact time steps of the cell models as kernels: each cell with its own parameters, under a load linear in each step.

All dynamic parts of a cell are first-order lags, discretised exactly (:mod:`._lag`). A lag that charges and discharges
with different time constants changes over within the step. Weights are computed when the time step changes.
"""

from __future__ import annotations

import math
from typing import Annotated

from ...common.arrays import FloatArray
from ...common.compiled import Record, Records, Row, Rows, loop
from ._lag import weights_of

Pair = Annotated[FloatArray, 2]


class PaperCell(Record):
    """Parameters of a paper cell, see :class:`._models.PaperModel`, and the weights of its last time step."""

    eu1: float
    """load per r: in the unit of the loads, as the next ones"""
    etau2: float
    e1: float
    e2: float
    e3: float
    t_s: Annotated[FloatArray, 3]
    """time constants: settling, fast and slow branch"""
    gone: Annotated[FloatArray, 3]
    ramp: Annotated[FloatArray, 3]


class PaperMemory(Record):
    """Memory of a paper cell; all zeros: at rest."""

    load: float
    r: float
    rising: float
    """1 in the rising phase, else 0; at rest either phase has the same memory"""
    settled: float
    """load behind the lag of the rising phase"""
    x2: float
    x3: float


class M10Cell(Record):
    """Parameters of an m10 cell, see :class:`._models.M10Model`, and the weights of its last time step."""

    a: float
    b: float
    alpha: Pair
    rise_s: Pair
    fall_s: Pair
    k: float
    tau_s: float
    rise_gone: Pair
    rise_ramp: Pair
    fall_gone: Pair
    fall_ramp: Pair
    heals: float
    heals_ramp: float


class M10Memory(Record):
    """Memory of an m10 cell; all zeros: at rest."""

    load: float
    """of full scale"""
    x: Pair
    """r of the branches"""
    broken: float
    """r of the broken chains"""


@loop
def run_paper(cells: Records[PaperCell], memory: Records[PaperMemory], dt_s: Row, loads: Rows, found: Rows) -> None:
    """Step cells through ``loads`` (n, m) in steps ``dt_s`` (n,); writes r to ``found`` (n, m).

    ``cells`` (m,), or one for all. The rising phase holds while the load rises and is then held, recovery from a fall
    to the next rise. r is continuous at each change of phase.
    """
    for n in range(loads.shape[0]):
        if n == 0 or dt_s[n] != dt_s[n - 1]:
            for i in range(cells.size):
                for j in range(3):
                    cells[i].gone[j], cells[i].ramp[j] = weights_of(dt_s[n], cells[i].t_s[j])
        for i in range(loads.shape[1]):
            found[n, i] = step_paper(cells[i if cells.size > 1 else 0], memory[i], loads[n, i])


@loop
def step_paper(c: PaperCell, m: PaperMemory, load: float) -> float:
    """Go to ``load``; returns r."""
    before, change = m.load, load - m.load
    if change > 0.0 and m.rising == 0.0:
        m.settled, m.rising = before * (1.0 + c.etau2 / c.eu1) - c.etau2 * m.r, 1.0
    elif change < 0.0 and m.rising > 0.0:
        m.x2, m.rising = m.r - before / c.e1 - m.x3, 0.0
    m.settled += (before - m.settled) * c.gone[0] + change * c.ramp[0]
    m.x2 += (before / c.e2 - m.x2) * c.gone[1] + change / c.e2 * c.ramp[1]
    m.x3 += (before / c.e3 - m.x3) * c.gone[2] + change / c.e3 * c.ramp[2]
    m.load = load
    m.r = load / c.eu1 + (load - m.settled) / c.etau2 if m.rising > 0.0 else load / c.e1 + m.x2 + m.x3
    return float(m.r)


@loop
def run_m10(cells: Records[M10Cell], memory: Records[M10Memory], dt_s: Row, loads: Rows, found: Rows) -> None:
    """Step cells through ``loads`` (n, m) in steps ``dt_s`` (n,); writes r to ``found`` (n, m); ``cells`` as above."""
    for n in range(loads.shape[0]):
        if n == 0 or dt_s[n] != dt_s[n - 1]:
            for i in range(cells.size):
                c = cells[i]
                for j in range(2):
                    c.rise_gone[j], c.rise_ramp[j] = weights_of(dt_s[n], c.rise_s[j])
                    c.fall_gone[j], c.fall_ramp[j] = weights_of(dt_s[n], c.fall_s[j])
                c.heals, c.heals_ramp = weights_of(dt_s[n], c.tau_s)
        for i in range(loads.shape[1]):
            found[n, i] = step_m10(cells[i if cells.size > 1 else 0], memory[i], dt_s[n], loads[n, i])


@loop
def step_m10(c: M10Cell, m: M10Memory, dt_s: float, load: float) -> float:
    """Go to ``load``; returns r."""
    for j in range(2):
        x, before, after = m.x[j], c.alpha[j] * m.load, c.alpha[j] * load
        lead, change = before - x, after - before
        charges = lead > 0.0 or (lead == 0.0 and change > 0.0)
        gone, ramp = (c.rise_gone[j], c.rise_ramp[j]) if charges else (c.fall_gone[j], c.fall_ramp[j])
        m.x[j] = x + lead * gone + change * ramp
        if dt_s > 0.0 and lead * (after - m.x[j]) < 0.0:
            first_s, second_s = (c.rise_s[j], c.fall_s[j]) if charges else (c.fall_s[j], c.rise_s[j])
            m.x[j] = changed_over(x, before, after, dt_s, first_s, second_s)
    m.broken = m.broken * (1.0 - c.heals) + c.k * abs(load - m.load) * (1.0 - c.heals_ramp)
    m.load = load
    return float(c.a * load + c.b * load**2 + (m.x[0] + m.x[1]) + m.broken)


@loop
def changed_over(x: float, before: float, after: float, dt_s: float, first_s: float, second_s: float) -> float:
    """A lag after a step within which it catches up with its input, and changes its time constant.

    Let w = u - x and u' = v, so that w' = v - w/T. From zero, w can only move towards the sign of v. Hence w changes
    sign at most once in a step, at the time T log(1 - w0/(v T)).
    """
    change = after - before
    since_s = min(first_s * math.log1p((x - before) * dt_s / (change * first_s)), dt_s)
    middle = before + change * (since_s / dt_s)
    gone, ramp = weights_of(since_s, first_s)
    x += (before - x) * gone + (middle - before) * ramp
    gone, ramp = weights_of(dt_s - since_s, second_s)
    return float(x + (middle - x) * gone + (after - middle) * ramp)
