"""The live recovery: quantised frames of every circuit, and what it says of its own errors."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from designs import KINDS, digitised
from live import counts_of

from ohmskin.bench import _live_search, _live_streams
from ohmskin.circuits import Design, Reason, adc_codes, live_recovery, scan
from ohmskin.driver import CountReader, Measurement
from ohmskin.errors import InputError

EVERY = "grounded", "rows", "floating", "divider", "open divider", "feedback"


def board(kind: str, rows: int, columns: int, bits: int, **array: Any) -> Design:
    amplified = KINDS[kind][0].endswith("amplifier")
    readout: dict[str, Any] = {"reference_resistance": 1e3} if amplified else {}
    if KINDS[kind][0] != "voltage-divider":
        readout |= {"open_loop_gain": 1e5, "offset_voltage": 1e-3, "supply": [-0.2, 3.3]}
    adc = {"range": [-0.1, 1.0] if amplified else [0.0, 3.3]}
    return digitised(kind, rows, columns, bits, lead=25.0, array=array, readout=readout, adc=adc)


def pressed(shape: tuple[int, int], rng: np.random.Generator, frames: int, hard_ohm: float) -> np.ndarray:
    """(frames, rows, columns) ohm: two fingers that wander over a skin at rest and press more or less."""
    rest = 1e4 * 10 ** rng.uniform(-0.1, 0.1, shape)
    place = rng.uniform(0, 1, (2, 2)) * shape
    i, j = np.indices(shape)
    result = []
    for number in range(frames):
        place = (place + rng.normal(0, 0.1, (2, 2))) % shape
        load = sum(
            np.exp(-((i - a) ** 2 + (j - b) ** 2)) * (0.5 + 0.5 * np.sin(number / 5 + k))
            for k, (a, b) in enumerate(place)
        )
        result.append(1 / (1 / rest + np.minimum(load, 1.0) ** 2 * (1 / hard_ohm - 1e-4)))
    return np.array(result)


def relative_error(found: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Of conductances, 0 where nothing was found."""
    return np.nan_to_num(np.abs(cells / found - 1), nan=0.0, posinf=0.0)


@pytest.mark.parametrize("kind", EVERY)
@pytest.mark.parametrize("bits", [8, 12])
def test_valid_cells_lie_within_what_is_claimed_whatever_the_converter(kind: str, bits: int) -> None:
    rng = np.random.default_rng(bits)
    valid = cells = 0
    for hard_ohm in (2000.0, 150.0):  # the second one saturates outputs and converter
        design = board(kind, int(rng.integers(3, 8)), int(rng.integers(3, 8)), bits)
        read = CountReader(design)
        for frame in pressed(design.array.shape, rng, 25, hard_ohm):
            reading = read(counts_of(design, frame))
            assert (reading.reason != Reason.UNSOLVED).all()
            error = relative_error(reading.resistance, frame)
            assert (error[reading.valid] <= 1.5 * reading.uncertainty[reading.valid]).all()
            assert (error[reading.valid] < 0.5).all()  # never off by a factor of two
            valid, cells = valid + reading.valid.sum(), cells + frame.size
    if "divider" not in kind:  # 8 bits do not resolve a cell of a loaded grid
        assert valid > 0.4 * cells


@pytest.mark.parametrize(("lead", "segment"), [(0.0, 0.0), (5.0, 0.0), (25.0, 1.0), (50.0, 5.0)])
@pytest.mark.parametrize("kind", ["grounded", "rows"])
def test_amplified_cells_are_known_to_an_adc_step(kind: str, lead: float, segment: float) -> None:
    lines = {"row_lead": lead, "column_lead": lead, "row_segment": segment, "column_segment": segment}
    design = board(kind, 9, 12, 12, **lines)
    read = CountReader(design)
    for frame in pressed((9, 12), np.random.default_rng(3), 40, 2500.0):
        reading = read(counts_of(design, frame))
        assert reading.valid.all()
        step = design.adc.step / scan(design, frame).volts  # type: ignore[union-attr]
        assert (relative_error(reading.resistance, frame) <= 1.3 * step + 2e-4).all()


def test_unequal_offsets_and_gains_are_taken_out() -> None:
    rng = np.random.default_rng(7)
    design = board("grounded", 6, 5, 16).replace(
        readout={"offset_voltage": rng.uniform(-3e-3, 3e-3, 5).tolist(), "open_loop_gain": [1e3, 1e4, 1e5, 1e9, 1e2]}
    )
    read = CountReader(design)
    for frame in pressed((6, 5), rng, 20, 2000.0):
        reading = read(counts_of(design, frame))
        assert reading.valid.all()
        np.testing.assert_allclose(reading.resistance, frame, rtol=2e-3)


@pytest.mark.parametrize("seed", range(6))
def test_unknown_cells_disturb_no_valid_one(seed: int) -> None:
    """Cells far beyond the limit: a valid neighbour is right all the same."""
    rng = np.random.default_rng(seed)
    lead = float(rng.choice([0.0, 1.0, 25.0, 100.0]))
    design = board("grounded", 7, 6, 12, row_lead=lead, column_lead=float(rng.choice([0.0, 5.0])))
    read = CountReader(design)
    for frame in pressed((7, 6), rng, 12, 2000.0):
        for place in rng.choice(frame.size, 3, replace=False):
            frame.flat[place] = 10 ** rng.uniform(-3, 2.3)
        reading = read(counts_of(design, frame))
        error = relative_error(reading.resistance, frame)
        assert (error[reading.valid] <= 1.5 * reading.uncertainty[reading.valid]).all()
        assert (reading.reason[frame < 300] != Reason.VALID).all()


def test_what_a_frame_did_not_settle_the_next_ones_do() -> None:
    design = board("grounded", 8, 8, 12, row_lead=100.0, column_lead=100.0)
    read, rng = CountReader(design), np.random.default_rng(1)
    for frame in 10 ** rng.uniform(3.3, 4.5, (5, 8, 8)):
        counts = counts_of(design, frame)
        for _ in range(6):
            reading = read(counts)
        assert reading.valid.all()
        assert (relative_error(reading.resistance, frame) <= 1.5 * reading.uncertainty).all()


@pytest.mark.parametrize("bits", [6, 12])
def test_outputs_that_come_back_from_a_limit_are_read_where_the_next_frame_confirms_them(bits: int) -> None:
    """All cells at once, to half of the range: after one frame nobody can say whether noise has begun."""
    design = board("grounded", 3, 3, bits).replace(adc={"range": (-0.1, 3.3)})
    pressed_hard, released = np.full((3, 3), 10.0), np.full((3, 3), 600.0)
    read = CountReader(design)
    for cells in (*[released] * 6, *[pressed_hard] * 6):
        reading = read(counts_of(design, cells))
    assert (reading.reason == Reason.SATURATED).all()
    counts = adc_codes(design, scan(design, released).volts)
    assert (read(counts).reason == Reason.SATURATED).all()
    assert read(counts).valid.all()


@pytest.mark.parametrize("kind", EVERY)
def test_a_pickled_reader_goes_on_with_the_noise_that_it_has_measured(kind: str) -> None:
    design, rng = board(kind, 4, 4, 12), np.random.default_rng(0)
    assert design.adc is not None
    read = CountReader(design, accuracy=0.4)
    for number, cells in enumerate(pressed((4, 4), rng, 12, 2e3)):
        noisy = scan(design, cells).volts + rng.normal(scale=2.0 * design.adc.step, size=cells.shape)
        counts = adc_codes(design, noisy)
        read(counts)
        if number == 7:
            there = pickle.loads(pickle.dumps(read))
            assert there.noise_volts == pytest.approx(read.noise_volts, rel=0.3)
            assert there.noise_volts > design.adc.step
        if number > 7:
            gone_on = there(counts)
            assert gone_on.valid.mean() >= 0.5
            error = relative_error(gone_on.resistance, cells)
            assert (error <= 5.0 / 3.0 * gone_on.uncertainty)[gone_on.valid].all()


def test_a_design_without_a_converter_is_refused() -> None:
    with pytest.raises(InputError, match=r"no \[adc\] section"):
        live_recovery(board("grounded", 2, 2, 12).replace(adc=None))


def test_noise_does_not_bring_a_saturated_output_back_to_life() -> None:
    """An output at its limit, with noise of half a step, is read on either side of the limit."""
    design = board("grounded", 6, 6, 12, row_lead=5.0, column_lead=5.0).replace(
        readout={"supply": [-0.1, 3.3], "reference_resistance": 20e3}, adc={"range": [0.0, 3.3]}
    )
    rng, read = np.random.default_rng(0), CountReader(design)
    cells = 10 ** rng.uniform(4.0, 4.3, (6, 6))
    cells[2, 3] = cells[5, 0] = 5.0
    volts = scan(design, cells).volts
    for _ in range(200):
        noisy = volts + rng.normal(scale=0.5 * design.adc.step, size=volts.shape)  # type: ignore[union-attr]
        reading = read(adc_codes(design, noisy))
        assert not reading.valid[cells < 100].any()  # in the first frame, too
        assert (relative_error(reading.resistance, cells)[reading.valid] < 0.01).all()
        assert reading.valid.sum() >= 10


@pytest.mark.parametrize("family", ["inverting", "row", "floating", "divider", "loaded", "open divider", "feedback"])
def test_the_search_finds_nothing_in_its_first_streams(family: str) -> None:
    """Quantised streams of random boards, with and without noise, saturated cells and faults (bench.search --live)."""
    tally = _live_search.LiveTally()
    for number in range(2000, 2005):
        _live_search.check(family, number, tally)
    assert tally.findings == []
    assert tally.valid > 0


def test_the_search_notices_a_wrong_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    tally = _live_search.LiveTally()
    real = _live_streams.scan
    monkeypatch.setattr(_live_streams, "scan", lambda design, cells, **how: real(design, 1.2 * cells, **how))
    for number in range(2000, 2006):
        _live_search.check("inverting", number, tally)
    assert tally.count("wrong cell") >= 3


@pytest.mark.parametrize("sigma_steps", [0.5, 3.0])
def test_the_noise_of_the_readings_is_in_the_uncertainty(sigma_steps: float) -> None:
    """Measured from frame to frame, while two fingers press: 3 standard deviations, hence 0.3 % of cells beyond."""
    design = board("grounded", 8, 8, 12)
    rng, read, beyond, cells = np.random.default_rng(5), CountReader(design), 0, 0
    assert design.adc is not None
    for number, frame in enumerate(pressed((8, 8), rng, 60, 2500.0)):
        volts = scan(design, frame).volts + rng.normal(scale=sigma_steps * design.adc.step, size=(8, 8))
        reading = read(adc_codes(design, volts))
        if number:
            off = np.abs(reading.resistance / frame - 1)[reading.valid]
            beyond, cells = beyond + int((off > reading.uncertainty[reading.valid]).sum()), cells + off.size
    assert cells > 3000
    assert beyond <= 0.003 * cells
    assert 0.8 * sigma_steps < read.noise_volts / design.adc.step < 3.0 * sigma_steps


def test_the_noise_that_a_design_names_counts_from_the_first_frame() -> None:
    noisy = board("grounded", 4, 4, 16).replace(
        readout={"voltage_noise": 1e-6, "gain_bandwidth": 1e6, "column_capacitance": 1e-10}
    )
    cells, quiet = np.full((4, 4), 1e4), board("grounded", 4, 4, 16)
    assert CountReader(noisy).noise_volts > 1e-4
    seen = [read(adc_codes(quiet, scan(quiet, cells).volts)).uncertainty for read in map(CountReader, (quiet, noisy))]
    assert (seen[1] > 2 * seen[0]).all()


def test_the_accuracy_asked_for_decides_what_is_valid() -> None:
    design = board("grounded", 4, 4, 8)
    counts = adc_codes(design, scan(design, np.full((4, 4), 5e3)).volts)
    (own,) = {round(float(value), 3) for value in _second(design, counts, None).uncertainty.ravel()}
    assert _second(design, counts, None).valid.all()
    assert _second(design, counts, 1.2 * own).valid.all()
    refused = _second(design, counts, 0.8 * own)
    assert (refused.reason == Reason.UNCERTAIN).all()
    for absurd in (0.0, 1.0, -0.1, np.nan):
        with pytest.raises(InputError, match="accuracy"):
            CountReader(design, accuracy=absurd)


def _second(design: Design, counts: np.ndarray, accuracy: float | None) -> Measurement:
    read = CountReader(design, accuracy=accuracy)
    read(counts)
    return read(counts)


def test_a_known_short_beside_a_cell_makes_the_cell_less_certain() -> None:
    """A tenth of the current is the cell's: an error of the reading weighs ten times."""
    whole = board("grounded", 3, 3, 10)
    shunted = whole.replace(fault=({"kind": "shorted-cell", "place": [1, 1], "resistance": 2e3},))
    cells = np.full((3, 3), 18e3)
    for lead in (0.0, 25.0):
        design = shunted.replace(array={"row_lead": lead, "column_lead": lead})
        reading = _second(design, counts_of(design, cells), 0.5)
        assert reading.valid[1, 1]
        error = relative_error(reading.resistance, cells)
        assert (error <= reading.uncertainty).all()
        total = 1 / 18e3 + 1 / 2e3
        own_step = 0.5 * design.adc.step / 1e3 / total  # type: ignore[union-attr]
        assert reading.uncertainty[1, 1] > 9 * own_step
