"""Streams and batches read what single frames read."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.circuits import METHODS, Adc, Design, Scanner, scan, scan_batch
from ohmskin.errors import InputError, SolverError

DESIGNS = {
    "plain": amplifier(10, 12, lead=2.0, segment=1.0),
    "ideal lines": amplifier(10, 12, lead=2.0),
    "saturating": amplifier(10, 12, lead=2.0, segment=1.0, supply=(-1.0, 0.9), open_loop_gain=1e5),
    "offset": amplifier(10, 12, lead=2.0, segment=1.0, offset_voltage=1e-3, open_loop_gain=1e4),
    "divider": divider(10, 12, idle_rows="ground", idle_columns="load", row_lead=3.0, column_segment=1.0),
}


def frames(count: int, seed: int, shape: tuple[int, int] = (10, 12)) -> np.ndarray:
    """Contacts that come and go, with an open and a shorted cell now and then."""
    rng = np.random.default_rng(seed)
    cells = np.repeat(10 ** rng.uniform(4, 6, (1, *shape)), count, axis=0)
    for k in range(1, count):
        cells[k] = cells[k - 1]
        row, column = (rng.integers(side) for side in shape)
        patch = cells[k, row : row + 3, column : column + 2]
        patch *= 10 ** rng.uniform(-0.7, 0.7, patch.shape)
        if rng.random() < 0.2:
            cells[k, row, column] = rng.choice([0.0, inf])
    return cells


@pytest.mark.parametrize("asked", [{}, {"tolerance": 1e-3}, {"tolerance": 1e-9}, *({"method": m} for m in METHODS)])
@pytest.mark.parametrize("name", DESIGNS)
def test_a_stream_reads_what_single_frames_read(name: str, asked: dict[str, Any]) -> None:
    design, stream = DESIGNS[name], frames(12, 1)
    scanner = Scanner(design, **asked)
    for cells in stream:
        kept, alone = scanner.scan(cells), scan(design, cells, **asked)
        assert kept.method == alone.method
        np.testing.assert_allclose(kept.volts, alone.volts, rtol=1e-11)
        np.testing.assert_array_equal(kept.saturated, alone.saturated)
        assert kept.error_bound == pytest.approx(alone.error_bound, rel=1e-6)


def test_a_stream_of_many_blocks_is_as_good_as_single_frames_and_says_so() -> None:
    design, shape = amplifier(27, 33, lead=2.0, segment=1.0), (27, 33)
    scanner, rng = Scanner(design, method="exact"), np.random.default_rng(6)
    stream = [*frames(5, 7, shape), *frames(2, 8, shape)]
    stream.append(stream[-1] * np.where(rng.random(shape) < 0.3, 1.5, 1.0))
    for cells in stream:
        kept, alone = scanner.scan(cells), scan(design, cells, method="exact")
        np.testing.assert_allclose(kept.volts, alone.volts, rtol=1e-12)
        assert kept.error_bound == pytest.approx(alone.error_bound, rel=1e-6)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from(METHODS))
def test_a_stream_forgets_nothing_and_keeps_nothing_stale(seed: int, method: str) -> None:
    design = amplifier(11, 9, lead=2.0, segment=3.0)
    scanner = Scanner(design, method=method)
    stream = frames(6, seed, (11, 9))
    for cells in [*stream, *stream[::-2]]:
        np.testing.assert_allclose(scanner.scan(cells).volts, scan(design, cells, method=method).volts, rtol=1e-11)


def test_a_frame_that_is_the_last_one_is_not_solved_again(monkeypatch: pytest.MonkeyPatch) -> None:
    design, cells = DESIGNS["plain"], frames(1, 2)[0]
    scanner = Scanner(design)
    first = scanner.scan(cells)
    with monkeypatch.context() as patched:
        patched.delattr("ohmskin.circuits._incremental.solve")
        np.testing.assert_array_equal(scanner.scan(cells.copy()).volts, first.volts)
    cells[0, 0] *= 2  # the caller's own array
    assert scanner.scan(cells).volts[0, 0] < first.volts[0, 0]


def test_what_a_caller_does_to_a_result_stays_with_it() -> None:
    design, cells = DESIGNS["saturating"], frames(1, 2)[0]
    scanner, alone = Scanner(design), scan(design, cells)
    for _ in range(3):
        result = scanner.scan(cells)
        np.testing.assert_array_equal(result.volts, alone.volts)
        np.testing.assert_array_equal(result.saturated, alone.saturated)
        np.testing.assert_array_equal(result.resistance, alone.resistance)
        result.volts[:] = 7.0
        result.resistance[:] = 7.0
        result.cells[:] = 7.0
        result.saturated[:] = True


@pytest.mark.parametrize("asked", [{}, {"tolerance": 1e-3}, {"tolerance": 1e-9}, *({"method": m} for m in METHODS)])
@pytest.mark.parametrize("name", DESIGNS)
def test_a_batch_reads_what_a_loop_reads(name: str, asked: dict[str, Any]) -> None:
    design, cells = DESIGNS[name], frames(7, 3)
    batch = scan_batch(design, cells, **asked)
    for k, frame in enumerate(cells):
        one = scan(design, frame, **asked)
        np.testing.assert_allclose(batch.volts[k], one.volts, rtol=1e-11 if batch.method[k] == one.method else 1e-2)
        np.testing.assert_array_equal(batch.saturated[k], one.saturated)
        np.testing.assert_allclose(
            batch.resistance[k], one.resistance, rtol=1e-9 if batch.method[k] == one.method else 1
        )
        if "tolerance" in asked:
            assert batch.error_bound[k] <= asked["tolerance"]


def test_a_batch_through_an_adc_keeps_a_quarter_step() -> None:
    adc = Adc(bits=10, range=(0.0, 1.0))
    design: Design = DESIGNS["plain"].replace(adc=adc)
    cells = 10 ** np.random.default_rng(4).uniform(4, 6, (5, 10, 12))
    batch = scan_batch(design, cells)
    assert set(batch.method) == {"attenuation"}
    assert np.abs(batch.volts - scan_batch(DESIGNS["plain"], cells).volts).max() <= adc.step / 4


def test_batches_of_nothing_and_of_one_row() -> None:
    assert scan_batch(amplifier(2, 3), np.empty((0, 2, 3))).volts.shape == (0, 2, 3)
    assert scan_batch(amplifier(1, 1, lead=1.0), np.full((4, 1, 1), 1e3)).method == ("exact",) * 4


def test_bad_frames_are_named() -> None:
    cells = np.ones((3, 2, 2))
    with pytest.raises(InputError, match=r"shape \(3, 2, 2\), expected \(frames, 2, 5\)"):
        scan_batch(amplifier(2, 5), cells)
    cells[1, 0, 1] = np.nan
    with pytest.raises(InputError, match="frame 1: cell resistance at row 0, column 1 is nan"):
        scan_batch(amplifier(2, 2), cells)
    with pytest.raises(InputError, match="not numbers"):
        scan_batch(amplifier(2, 2), [[["a"]]])
    with pytest.raises(InputError, match="unknown method"):
        Scanner(amplifier(2, 2), method="magic")
    with pytest.raises(SolverError, match="no method certifies"):
        scan_batch(amplifier(2, 2, lead=1.0, segment=1.0), np.ones((3, 2, 2)), tolerance=1e-18)
