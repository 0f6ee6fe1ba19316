"""Tremors that cells of a contact share, weaker than the noise of a reading: neighbours tell them."""

from __future__ import annotations

import numpy as np
import pytest
from cells import EXAMPLE, FULL

from ohmskin.cell.estimation._neighbours import ALIKE, NEAR, Neighbours

DT, SHAPE = 0.005, (7, 12)
TIME = np.arange(1, round(7.0 / DT)) * DT
HERTZ = np.array([1.7, 2.6, 3.7, 5.3, 7.1])
TREMBLES = np.sin(2 * np.pi * HERTZ * TIME[:, None] + HERTZ).sum(axis=1) * np.sqrt(2 / HERTZ.size)
ROW, COLUMN = np.indices(SHAPE)


def contact(row: float, column: float) -> np.ndarray:
    """(rows, columns) of 45 % of full scale in the midst."""
    return np.asarray(0.45 * FULL * np.exp(-((ROW - row) ** 2 + (COLUMN - column) ** 2) / (2 * 0.9**2)))


def judged(load: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, rows, columns) of the default in kPa, and its deviations."""
    read = EXAMPLE.forward(SHAPE).run(np.full(len(load), DT), load) * (1.0 + noise)
    estimator = EXAMPLE.estimator(SHAPE)
    estimator.compile()
    shown, std = np.array([(estimator.step(DT, ohms), estimator.std_kpa) for ohms in read]).swapaxes(0, 1)
    return shown - load, std


@pytest.mark.parametrize("in_columns", [False, True], ids=["noise of cells", "noise of columns"])
def test_a_tremor_below_the_noise_is_told_by_neighbours_and_spoils_no_contact_beside(in_columns: bool) -> None:
    """One contact trembles by 2 %, one is still, in noise of 0.6 % of the reading; it may be that of whole columns."""
    held = np.interp(TIME, [0.5, 0.8], [0.0, 1.0])[:, None, None]
    trembles = 1.0 + 0.02 * (TREMBLES * (TIME > 1.0))[:, None, None]
    load = held * (contact(3.0, 2.3) * trembles + contact(3.2, 9.0))
    random = np.random.default_rng(4)
    noise = 0.006 * random.standard_normal(load.shape)
    if in_columns:
        noise = 0.003 * random.standard_normal(load.shape) + 0.005 * random.standard_normal((len(load), 1, SHAPE[1]))
    error, std = judged(load, noise)
    bears, late = load[-1] > 0.03 * FULL, TIME > 2.0
    for name, side in (("trembling", COLUMN < 6), ("still", COLUMN >= 6)):
        off, may = error[late][:, bears & side], std[late][:, bears & side]
        rms, within = np.sqrt((off**2).mean()) / FULL, (np.abs(off) < 2 * may).mean()
        wide = np.median(may) / FULL
        print(f"{name}: error {100 * rms:.1f} % FS rms, {100 * within:.1f} % within 2 sd, sd {100 * wide:.1f} %")
        assert rms < (0.05 if in_columns else 0.03)
        assert within > 0.95
        assert wide < 0.04


@pytest.mark.parametrize("frames", [8.0, 5.4])
def test_a_grip_that_trembles_by_few_frames_of_a_slow_board_does_not_grow(frames: float) -> None:
    """A plate trembles by 2 % of full scale at 20 frames per second, with so many in a period; 0.3 % of noise.

    Means of four readings hide nearly all of that: by such means loads grew by 22 and 45 % of full scale in twelve
    seconds.
    """
    dt, fine, shape = 0.05, 8, (6, 6)
    time = np.arange(1, round(16.0 / dt) * fine + 1) * (dt / fine)
    tremor = 0.02 * np.sin(2 * np.pi * time / (frames * dt)) * (time > 3.0)
    load = np.zeros((time.size, *shape))
    load[:, 1:5, 1:4] = FULL * (np.interp(time, [2.0, 2.5], [0.0, 0.4]) + tremor)[:, None, None]
    read = EXAMPLE.forward(shape).run(np.full(time.size, dt / fine), load)[fine - 1 :: fine]
    read *= 1.0 + 3e-3 * np.random.default_rng(5).standard_normal(read.shape)
    estimator = EXAMPLE.estimator(shape)
    estimator.compile()
    shown, std = np.array([(estimator.step(dt, ohms), estimator.std_kpa) for ohms in read]).swapaxes(0, 1)
    bears, late = load[-1] > 0.0, round(4.0 / dt)
    error, may = (shown - load[fine - 1 :: fine])[late:, bears], std[late:, bears]
    rms, within = np.sqrt((error**2).mean()) / FULL, (np.abs(error) < 2 * may).mean()
    grown, wide = error[-60:].mean() / FULL, np.median(may) / FULL
    within_sd = f"{100 * within:.1f} % within 2 sd, sd {100 * wide:.1f} %"
    print(f"error {100 * rms:.1f} % FS rms, grown by {100 * grown:.1f} %; {within_sd}")
    assert rms < 0.08
    assert abs(grown) < 0.06
    assert within > 0.95
    assert wide < 0.4


def test_neighbours_are_those_within_two_cells_by_columns() -> None:
    """Of all cells but one; the first group shares no column with the second."""
    cells = np.delete(np.arange(SHAPE[0] * SHAPE[1]), 17)
    near = Neighbours(SHAPE).among(cells)
    assert near.shape == (NEAR, cells.size)
    rows, columns = np.divmod(np.append(cells, -1000), SHAPE[1])
    for place, (row, column) in enumerate(zip(rows[:-1], columns[:-1], strict=True)):
        reached = (np.abs(rows - row) <= 2) & (np.abs(columns - column) <= 2)
        reached[place] = False
        alike = (columns - column) % 2 == 0
        for group, of_columns in ((near[:ALIKE, place], alike), (near[ALIKE:, place], ~alike)):
            assert sorted(group[group < cells.size]) == np.flatnonzero(reached & of_columns).tolist()
    assert np.all(Neighbours((5,)).among(np.arange(5)) == 5)
