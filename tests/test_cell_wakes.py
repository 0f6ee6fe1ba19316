"""A skin that is pressed as a whole: all its cells wake, and may have sparked, in one frame."""

from __future__ import annotations

import numpy as np
import pytest
from test_cell_compiled import CELLS, DT_S

from ohmskin.cell import Cell
from ohmskin.cell.estimation._loops import copy
from ohmskin.cell.estimation._remembered import Remembered
from ohmskin.cell.estimation._rows import PRESSURE
from ohmskin.cell.estimation._smoothing import begin
from ohmskin.cell.estimation._taps import EVEN, LEAST_LINE, SEEN, WHOLE, Taps
from ohmskin.common import compiled
from ohmskin.common.arrays import spaced

SHAPE = (12, 10)
NEEDS_LOOPS = pytest.mark.skipif(compiled.why_not() is not None, reason="the extra 'fast' is not in use")


def moved(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Memory (rows, 5) of cells of a kind that have been pressed and let go, and readings (5,) of r."""
    cell = CELLS[kind]
    shares = np.linspace(0.1, 0.9, 5)
    estimator = cell.estimator((5,), noise=1e-4)
    load = np.concatenate([np.zeros(5), np.linspace(0.0, 1.0, 20), np.linspace(1.0, 0.4, 15)])
    ohms = cell.forward((5,)).run(np.full(load.size, DT_S), cell.full_scale_kpa * load[:, None] * shares)
    for ohm in ohms:
        estimator.step(DT_S, ohm)
    return estimator._remembered.block.memory.copy(), ohms[-1] / cell.rest_resistance_ohm - 1.0


@pytest.mark.parametrize("kind", CELLS)
def test_a_held_load_is_that_of_a_memory_that_begins_with_it(kind: str) -> None:
    inversion, (_, r) = CELLS[kind].estimator((5,)).inversion, moved(kind)
    np.testing.assert_array_equal(inversion.held_kpa(r), inversion.begin(r)[PRESSURE])


@pytest.mark.parametrize("kind", CELLS)
def test_a_load_that_is_held_in_parts_is_remembered_like_one_that_is_held_at_once(kind: str) -> None:
    """So that what cells remembered before a jump is brought up only where the jump is taken back."""
    inversion, (memory, _) = CELLS[kind].estimator((5,)).inversion, moved(kind)
    in_parts = memory
    for _ in range(8):
        in_parts = inversion.hold(in_parts, DT_S)
    np.testing.assert_allclose(in_parts, inversion.hold(memory, np.full(5, 8 * DT_S)), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shape", [(12, 10), (20, 3), (4, 40)])
def test_lines_that_moved_as_a_whole_are_those_most_of_whose_cells_did(shape: tuple[int, int]) -> None:
    """Against counts of the cells of each line."""
    inversion, rng = CELLS["contact"].estimator(shape).inversion, np.random.default_rng(0)
    for share in (0.6, 0.8, 0.9, 1.0):
        taps, n = Taps(inversion, shape), shape[0] * shape[1]
        taps._before = 0.02 * rng.standard_normal(n)
        reading = taps._before - np.where(rng.random(n) < share, rng.uniform(0.1, 0.9, n), 0.0)
        noise = np.full(n, 1e-3)
        cells = np.flatnonzero(reading < taps._before - 0.3)
        before = taps._before[cells]
        whole, ends_column, ends_row = taps._lines(cells, before, reading[cells] - before, reading, noise)
        seen = (reading - taps._before) * inversion.side > SEEN * noise
        rise = np.where(seen, inversion.held_kpa(reading) - inversion.held_kpa(taps._before), 0.0).reshape(shape)
        for place, cell in enumerate(cells):
            row, column = divmod(int(cell), shape[1])
            least = EVEN * (inversion.held_kpa(reading[cell, None]) - inversion.held_kpa(before[place, None]))
            lines = [line > least for line in (rise[row], rise[:, column])]
            assert whole[place] == any(line.sum() >= WHOLE * line.size for line in lines if line.size >= LEAST_LINE)
            assert ends_row[place] == (lines[0][0] or lines[0][-1])
            assert ends_column[place] == (lines[1][0] or lines[1][-1])


def test_a_press_of_the_whole_skin_makes_no_memory_of_all_cells_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """To look for taps among 4096 jumps it was made four times a frame, and held once more: 12 ms for five frames."""
    cell = Cell.example()
    estimator = cell.estimator(SHAPE)
    rng, rest = np.random.default_rng(0), cell.rest_resistance_ohm

    def step(load: float) -> np.ndarray:
        return estimator.step(DT_S, rest * (1.0 + load) * (1.0 + 1e-3 * rng.standard_normal(SHAPE)))

    for _ in range(40):
        step(0.0)
    assert not estimator._sleep.awake.any()

    def refused(*_: object) -> None:
        raise AssertionError("a memory of all cells")

    monkeypatch.setattr(estimator.inversion, "begin", refused)
    monkeypatch.setattr(estimator.inversion, "hold", refused)
    for _ in range(8):
        pressure = step(0.5 * estimator.inversion.full_scale_r)
    assert estimator._sleep.awake.all()
    assert (pressure > 0.3 * cell.full_scale_kpa).all()


@NEEDS_LOOPS
@pytest.mark.parametrize("kind", CELLS)
def test_a_load_is_held_by_machine_code_as_by_array_operations(kind: str) -> None:
    """In the memory of a skin, of whose other cells nothing changes, whatever the rows hold that are not kept."""
    estimator, (memory, _) = CELLS[kind].estimator((5,)), moved(kind)
    inversion, kept = estimator.inversion, estimator.inversion.held_rows
    compiled.load(*inversion.loops_used())
    gaps_s, places = np.array([0.02, 0.02, 0.1, 3.0, 0.005]), np.array([6, 2, 3, 9, 0])
    whole = spaced(np.full((len(memory), 11), -7.0))
    expected = whole.copy()
    expected[:, places] = inversion.hold(memory, gaps_s)
    whole[:, places] = np.nan
    whole[np.ix_(kept, places)] = memory[kept]
    inversion.hold_compiled(whole, places, gaps_s)
    np.testing.assert_array_equal(whole, expected)


@pytest.mark.parametrize("by_loops", [False, True])
@pytest.mark.parametrize("kind", CELLS)
def test_a_step_needs_no_other_rows_than_a_held_load(kind: str, by_loops: bool) -> None:
    """What a tap has led to is worked out from those alone."""
    if by_loops and compiled.why_not() is not None:
        pytest.skip("the extra 'fast' is not in use")
    estimator, (memory, r) = CELLS[kind].estimator((5,)), moved(kind)
    inversion, std = estimator.inversion, np.full(5, 1e-4)
    compiled.load(*inversion.loops_used())
    partly = np.full(memory.shape, np.nan)
    partly[inversion.held_rows] = memory[inversion.held_rows]
    after = []
    for each in (memory, partly):
        if by_loops:
            taken = np.array([r, std, r, std])
            after.append(inversion.advance_compiled(each, taken, begin(r), DT_S))
        else:
            after.append(inversion.advance(each, DT_S, r, std, lambda: std))
    np.testing.assert_array_equal(after[1][inversion.held_rows], after[0][inversion.held_rows])


@NEEDS_LOOPS
@pytest.mark.parametrize("kind", CELLS)
def test_cells_that_are_followed_in_turn_remember_the_same_by_machine_code(kind: str) -> None:
    """Some cells stay from block to block, some come and go; in between the block's memory is replaced by another."""
    rng, cells = np.random.default_rng(0), 30
    by_loops, by_arrays = (Remembered(CELLS[kind].estimator((cells,)).inversion, cells) for _ in range(2))
    by_loops.compiled = compiled.load(copy)
    assert by_loops.compiled
    for share in (0.2, 0.3, 0.3, 1.0, 0.6, 0.0, 0.5, 1.0, 1.0, 0.2, 0.9, 0.9):
        wanted = rng.random(cells) < share
        if share == 0.5:
            by_loops.flush()
        memory, line = rng.random((len(by_loops.memory), wanted.sum())), rng.random((len(by_loops.line), wanted.sum()))
        for each in (by_loops, by_arrays):
            np.testing.assert_array_equal(each.follow(wanted), np.flatnonzero(wanted))
        np.testing.assert_array_equal(by_loops.block.memory, by_arrays.block.memory)
        np.testing.assert_array_equal(by_loops.block.line, by_arrays.block.line)
        np.testing.assert_array_equal(by_loops.block.line_before, by_arrays.block.line)
        for each in (by_loops, by_arrays):
            each.block.memory = spaced(memory)
            each.block.line = line.copy()
    by_loops.flush()
    by_arrays.flush()
    np.testing.assert_array_equal(by_loops.memory, by_arrays.memory)
    np.testing.assert_array_equal(by_loops.line, by_arrays.line)


@pytest.mark.parametrize("kind", CELLS)
def test_a_state_is_restored_whatever_is_followed_then(kind: str) -> None:
    """Nothing that is remembered when a state is restored goes into it."""
    rng, every = np.random.default_rng(0), np.arange(8)
    remembered = Remembered(CELLS[kind].estimator((8,)).inversion, 8)
    remembered.begin(every, rng.random(8))
    saved = {name: value.copy() for name, value in remembered.state().items()}
    remembered.follow(every < 5)
    remembered.block.memory += 1.0
    remembered.restore(saved)
    remembered.flush()
    np.testing.assert_array_equal(remembered.memory, saved["memory"])
    np.testing.assert_array_equal(remembered.line, saved["line"])
