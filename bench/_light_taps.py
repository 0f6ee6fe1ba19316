"""Light taps that repeat: what the default estimator keeps of them, and whether its standard deviation says so.

``ohmskin bench --estimators`` prints the table. The paper's cell answers a rise by more than a fall. An estimator that
does not notice that a tap ended keeps a part of it, and these parts add up from tap to tap. Cells of one skin are
tapped lightly, each by a share of full scale of its own, alone or as the fringe of a strong tap in step with them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..cell import Cell
from ..circuits import adc_codes, scan
from ..common.arrays import FloatArray
from ..driver import CountReader
from ._honesty import estimated, readings, uncalibrated
from .boards import design

PEAKS = 0.01, 0.02, 0.04, 0.08
"""of full scale"""
STRONG = 0.6
"""of full scale: the tap of whose fringe they are"""
BEGIN_S, SECONDS = 1.0, 13.0
EDGE, HELD = 0.06, 0.4
"""of a period: how long a rise or a fall takes, and until when the load is held"""
SETTLED_S = 7.0
"""from when on what is left is judged: a few recovery times of the cells after the first tap"""
SUBSTEPS = 4
"""in which a frame of an amplifier is simulated"""
RESOLVED_AFTER = 5
"""frames of a divider, which tell its resolution"""
Board = Literal["amplifier", "divider"]


@dataclass(frozen=True)
class Case:
    """One skin, and the taps on it."""

    cell: str
    board: Board
    bits: int
    rate_hz: float
    noise_mv: float
    taps_hz: float
    fringe: bool
    """whether a strong tap is in step with the light ones"""


CASES = (
    *(Case("example", "amplifier", 12, 100.0, mv, hz, False) for mv in (0.1, 1.0, 4.0, 10.0) for hz in (0.5, 1.0, 3.0)),
    *(Case("paper", "amplifier", 12, 100.0, mv, hz, False) for mv in (0.1, 10.0) for hz in (1.0, 3.0)),
    *(Case("example", "amplifier", 12, rate, mv, 1.0, False) for rate in (50.0, 250.0) for mv in (1.0, 10.0)),
    *(Case("example", "amplifier", 12, 100.0, mv, 1.0, True) for mv in (1.0, 10.0)),
    *(Case("example", "amplifier", 8, 100.0, 0.3, hz, False) for hz in (1.0, 3.0)),
    *(Case("example", "divider", bits, 100.0, mv, 1.0, True) for bits, mv in ((12, 0.3), (12, 4.0), (8, 0.3))),
    *(Case("example", "divider", bits, 100.0, mv, 3.0, True) for bits, mv in ((12, 4.0), (10, 1.0))),
)


@dataclass(frozen=True)
class LightTaps:
    """The default estimator in one case; one number for each of :data:`PEAKS`."""

    case: Case
    kept: tuple[float, ...]
    """root mean square of what is shown between late taps, over the pressure of the taps"""
    std_percent: tuple[float, ...]
    """median of the stated deviations then, of full scale"""
    within_two: tuple[float, ...]
    """share of all errors within two stated deviations"""


def cells() -> dict[str, Cell]:
    """The cells of kind ``paper`` that are tapped, by name."""
    return {"example": Cell.example(), "paper": uncalibrated()["paper"]}


def train(time_s: FloatArray, taps_hz: float) -> FloatArray:
    """(n,) taps of height one."""
    phase = (time_s - BEGIN_S) * taps_hz % 1.0
    shape: FloatArray = np.interp(phase, [0.0, EDGE, HELD, HELD + EDGE], [0.0, 1.0, 1.0, 0.0])
    return shape * (time_s > BEGIN_S)


def judged(case: Case, seed: int = 0) -> LightTaps:
    """What the default estimator keeps of light taps."""
    frames = round(SECONDS * case.rate_hz)
    time_s = np.arange(1.0, frames + 1) / case.rate_hz
    run = _on_amplifier if case.board == "amplifier" else _on_divider
    share, pressure, std = run(cells()[case.cell], case, frames, np.random.default_rng(seed))
    full_kpa = cells()[case.cell].full_scale_kpa
    error = np.abs(pressure - full_kpa * share)
    known = time_s > BEGIN_S
    kept, stated, within = [], [], []
    for peak, column in zip(PEAKS, np.split(np.arange(share.shape[1]), len(PEAKS)), strict=True):
        rest = (share[:, column] == 0.0) & (time_s > SETTLED_S)[:, None]
        kept.append(float(np.sqrt(np.mean(error[:, column][rest] ** 2))) / (peak * full_kpa))
        stated.append(100.0 * float(np.median(std[:, column][rest])) / full_kpa)
        within.append(float(np.mean((error < 2.0 * std)[known][:, column])))
    return LightTaps(case=case, kept=tuple(kept), std_percent=tuple(stated), within_two=tuple(within))


def _on_amplifier(
    cell: Cell, case: Case, frames: int, random: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Loads of full scale, pressures and deviations in kPa (n, cells), two cells for each of :data:`PEAKS`."""
    step_s = 1.0 / case.rate_hz / SUBSTEPS
    fine_s = step_s * np.arange(1.0, frames * SUBSTEPS + 1)
    light = 2 * len(PEAKS)
    delays_s = np.zeros(light) if case.fringe else np.linspace(0.0, 0.37, light)
    share = np.repeat(PEAKS, 2) * train(fine_s[:, None] - delays_s, case.taps_hz)
    others = np.zeros((len(share), light))  # or strong ones: they, too, tell the noise
    if case.fringe:
        others[:] = STRONG * train(fine_s[:, None], case.taps_hz)
    every = np.concatenate([share, others], axis=1)
    read = readings(cell, every, 1.0 / case.rate_hz, case.noise_mv, random, case.bits, substeps=SUBSTEPS)
    pressure, std = estimated(cell, read, np.ones(frames, dtype=np.bool_), 1.0 / case.rate_hz, bits=case.bits)
    return share[SUBSTEPS - 1 :: SUBSTEPS], pressure[:, :light], std[:, :light]


def _on_divider(
    cell: Cell, case: Case, frames: int, random: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same, read by a board of 8 x 8 cells whose idle rows are grounded, so that cells share currents."""
    board = design("voltage-divider", "ground", "float", case.bits, cell.rest_resistance_ohm)
    time_s = np.arange(1.0, frames + 1) / case.rate_hz
    share = np.zeros((8, 8))
    light = (1, 3, 4, 6), (2, 5, 1, 4)
    share[light] = PEAKS
    if case.fringe:
        share[3, 3] = STRONG
    load = share * train(time_s, case.taps_hz)[:, None, None]
    ohm = cell.forward((8, 8)).run(np.full(frames, 1.0 / case.rate_hz), cell.full_scale_kpa * load)
    read, estimator = CountReader(board), cell.estimator((8, 8))
    estimator.compile()
    pressure, std = np.empty((2, frames, 8, 8))
    for n in range(frames):
        volts = scan(board, ohm[n]).volts
        reading = read(adc_codes(board, volts + 1e-3 * case.noise_mv * random.standard_normal((8, 8))))
        if n == RESOLVED_AFTER:
            estimator.resolve(*reading.resolution)
        pressure[n] = estimator.step(1.0 / case.rate_hz, reading.for_estimation)
        std[n] = estimator.std_kpa
    row, column = light
    return load[:, row, column], pressure[:, row, column], std[:, row, column]


def light_taps(cases: Iterable[Case] = CASES) -> Iterator[LightTaps]:
    """One row for each case."""
    for case in cases:
        yield judged(case)


def table(rows: Iterable[LightTaps]) -> str:
    """The rows as text."""
    peaks = "".join(f"{f'{100 * peak:g} %':>7}" for peak in PEAKS)
    head = (
        "light taps that repeat, default estimator, peaks of 1 to 8 % of full scale; what is shown between late taps\n"
        "(rms, over the pressure of the taps), its standard deviation (% of full scale), errors within two (%)\n"
        f"{'cell':<9}{'board':<10}{'bits':>5}{'frames/s':>9}{'mV':>5}{'taps/s':>7}{'fringe':>7}"
        f" |{peaks} |{peaks} |{peaks}"
    )
    lines = []
    for row in rows:
        case = row.case
        kept = "".join(f"{part:>7.2f}" for part in row.kept)
        std = "".join(f"{part:>7.1f}" for part in row.std_percent)
        within = "".join(f"{100 * part:>7.1f}" for part in row.within_two)
        lines.append(
            f"{case.cell:<9}{case.board:<10}{case.bits:>5}{case.rate_hz:>9g}{case.noise_mv:>5g}"
            f"{case.taps_hz:>7g}{'yes' if case.fringe else 'no':>7} |{kept} |{std} |{within}"
        )
    return "\n".join([head, *lines])
