"""The work of a frame is bounded, whatever the readings: counted in lines executed, so that no clock decides."""

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from ohmskin import cell as room
from ohmskin.bench import _honesty as honesty
from ohmskin.cell import Cell, Estimator, M10Model

DT = 0.01
CELLS = honesty.uncalibrated() | {
    "stiffening": Cell(
        rest_resistance_ohm=3000.0,
        full_scale_kpa=40.0,
        model=M10Model(a=0.4, b=0.2, alpha1=0.4, rise1_s=3.0, fall1_s=0.1, alpha2=0.2, fall2_s=50.0, k=0.15),
    )
}


def work(estimator: Estimator, read: np.ndarray) -> np.ndarray:
    """(n,) lines of the room that an estimator executes for each frame of readings (n, cells) in ohm."""
    folder, lines = str(Path(room.__file__).parent), 0

    def follow(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal lines
        lines += event == "line"
        return follow if frame.f_code.co_filename.startswith(folder) else None

    counted = []
    before = sys.gettrace()
    for ohm in read:
        lines = 0
        sys.settrace(follow)
        try:
            estimator.step(DT, ohm)
        finally:
            sys.settrace(before)
        counted.append(lines)
    return np.array(counted)


def pressed(cell: Cell, load: honesty.Load, noise_mv: float, frames: int = 500) -> np.ndarray:
    """Ohm (frames, 8) of eight cells under a load, from shortly before it begins."""
    time_s = 0.8 + DT / honesty.SUBSTEPS * np.arange(1.0, frames * honesty.SUBSTEPS + 1)
    share = honesty.pressures(load, time_s, frame_s=DT)
    return honesty.readings(cell, share, DT, noise_mv, np.random.default_rng(0), substeps=honesty.SUBSTEPS)


def wild(cell: Cell, frames: int = 300) -> np.ndarray:
    """Ohm (frames, 8) that no load gives: jumps of all sizes in every frame, and cells that open and return."""
    random = np.random.default_rng(1)
    settled = float(cell.forward(()).step(1e3, cell.full_scale_kpa)) / cell.rest_resistance_ohm
    size = 10.0 ** random.uniform(-4.0, 0.7, (frames, 8))
    read = cell.rest_resistance_ohm * settled ** (size * random.choice([-0.3, 1.0, 1.0], (frames, 8)))
    read[random.random((frames, 8)) < 0.02] = np.nan
    return np.asarray(read)


@pytest.mark.parametrize("kind", ["paper", "asymmetric", "m10", "stiffening", "contact"])
def test_no_frame_takes_more_than_ten_times_the_work_of_a_usual_one(kind: str) -> None:
    """Drumming in noise, after which the memory is lost, and readings that follow no model at all."""
    cell = CELLS[kind]
    usual = np.median(work(cell.estimator((8,)), pressed(cell, "press", 10.0)))
    for read in (pressed(cell, "drumming", 10.0), wild(cell)):
        assert work(cell.estimator((8,)), read)[10:].max() < 10 * usual


@pytest.mark.parametrize("kind", ["paper", "asymmetric", "m10", "contact"])
def test_cells_that_return_together_after_different_gaps_are_brought_up_together(kind: str) -> None:
    """A connector that slides off row by row, and is pushed on again: each cell has missed another number of frames."""
    cell = CELLS[kind]
    read = np.tile(pressed(cell, "hold", 1.0, 300), (1, 8))
    usual = np.median(work(cell.estimator((64,)), read))
    for place in range(64):
        read[100 + 2 * place : 250, place] = np.inf
    assert work(cell.estimator((64,)), read)[10:].max() < 5 * usual


@pytest.mark.parametrize("kind", ["paper", "m10"])
def test_gaps_of_different_lengths_are_held_as_one_by_one(kind: str) -> None:
    cell = CELLS[kind]
    read = pressed(cell, "taps", 1.0, 400)[:, :3]
    for place in range(3):
        read[200 + 40 * place : 350, place] = np.nan
    together = cell.estimator((3,), noise=0.0)
    alone = [cell.estimator((1,), noise=0.0) for _ in range(3)]
    for ohm in read:
        found = together.step(DT, ohm)
        apart = [estimator.step(DT, ohm[[place]]).item() for place, estimator in enumerate(alone)]
        # A matrix product rounds otherwise for three cells than for one, and pressures remember that.
        assert found == pytest.approx(apart, rel=1e-11, abs=1e-11)


@pytest.mark.parametrize("noise_mv", [0.1, 10.0])
@pytest.mark.parametrize("load", ["drumming", "vibration", "slip"])
def test_an_m10_cell_in_doubt_shows_no_more_than_a_load(load: honesty.Load, noise_mv: float) -> None:
    """Chains that break between two frames raise the reading far beyond any load's; they are told from one."""
    found = honesty.judged(CELLS["m10"], "m10", load, noise_mv)
    assert found.rmse_percent < 50.0
    assert found.within_two > 0.98
    cell = CELLS["m10"]
    read = pressed(cell, load, noise_mv, 900)
    pressure, _ = honesty.estimated(cell, read, np.ones(len(read), dtype=bool), DT)
    assert np.nanmax(pressure) < 1.35 * cell.full_scale_kpa
