"""Fast loads: what drumming leaves in an estimate, how far it may go, and how noise is measured meanwhile."""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.bench import judges, scenes
from ohmskin.cell import Cell, M10Model, PaperModel
from ohmskin.cell.estimation._noise import NoiseMeter

SUBSTEPS = scenes.SUBSTEPS
REMEMBERING = Cell(
    rest_resistance_ohm=10e3,
    full_scale_kpa=20.0,
    model=PaperModel(
        e1_kpa=130.0,
        e2_kpa=60.0,
        e3_kpa=110.0,
        eta2_kpa_s=600.0,
        eta3_kpa_s=15000.0,
        eu1_kpa=29.905,
        etau2_kpa=120.0,
        eu2_kpa_per_s=24.0,
    ),
)
"""recovers more slowly than a rise settles: its readings fall more slowly than a held load explains"""
SPIKY = Cell(
    rest_resistance_ohm=10e3,
    full_scale_kpa=20.0,
    model=M10Model(a=0.08, b=-0.07, alpha1=0.4, rise1_s=1.5, fall1_s=7.0, alpha2=0.2, fall2_s=100.0, k=0.1, tau_s=20.0),
)
"""has no exact inverse"""


def shown(
    cell: Cell, load: np.ndarray, dt: float, noise_mv: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loads, estimates and deviations (n, cells) over full scale, for ``load`` (n SUBSTEPS, cells)."""
    played = scenes.read(cell, load, dt, noise_mv, np.random.default_rng(seed))
    pressure, std, _ = judges.estimated(played, cell.estimator(load.shape[1:]))
    return load[SUBSTEPS - 1 :: SUBSTEPS], pressure / cell.full_scale_kpa, std / cell.full_scale_kpa


def times(seconds: float, dt: float) -> np.ndarray:
    """Of the steps in which frames are simulated."""
    return dt / SUBSTEPS * np.arange(1.0, round(seconds / dt) * SUBSTEPS + 1)


def sine_taps(time: np.ndarray, hz: float, end_s: float) -> np.ndarray:
    """Half sines from 1 s on, as many cells as shares of full scale."""
    wave = np.maximum(np.sin(2 * np.pi * hz * time), 0.0) * ((time > 1.0) & (time < end_s))
    return wave[:, None] * np.array([0.0, 0.0, 0.0, 0.3, 0.6, 0.9])


@pytest.mark.parametrize("cell", [REMEMBERING, SPIKY], ids=["remembering", "spiky"])
@pytest.mark.parametrize("noise_mv", [0.1, 1.0])
def test_a_drummed_cell_shows_no_overload_and_comes_back_to_rest(cell: Cell, noise_mv: float) -> None:
    """Forty taps raise the reading to many times that of a load; it heals within some tens of seconds."""
    dt = 0.01
    load, pressure, std = shown(cell, sine_taps(times(45.0, dt), 2.0, 21.0), dt, noise_mv)
    assert pressure.max() < 1.15
    z = np.abs(pressure - load) / std
    assert np.mean(z[50:] < 2) > 0.9
    assert np.mean(z[50:] < 3) > 0.99
    healed_s = 10.0 if cell is REMEMBERING else 20.0
    after = round((21.0 + healed_s) / dt)
    assert np.abs(pressure[after:]).max() < (0.15 if cell is REMEMBERING else 0.75)


def meter_of(r: np.ndarray, *, edges: np.ndarray | None = None) -> NoiseMeter:
    """A meter that has seen ``r`` (n, cells); ``edges`` (n, cells) marks where the smoothing begins a line."""
    meter = NoiseMeter(r.shape[1])
    since = np.full(r.shape[1], 100.0)
    for n, reading in enumerate(r):
        meter.update(reading, None)
        since += 1.0
        if edges is not None:
            since[edges[n]] = 0.0
        meter.on_line[...] = since
    return meter


@pytest.mark.parametrize("cells", [4, 64])
def test_taps_do_not_pass_for_noise(cells: int) -> None:
    """Three taps a second at 50 frames per second leave few readings without an edge beside them."""
    frames, noise = 600, 0.01
    pressed = (np.arange(frames) * 3 / 50 % 1.0 < 0.5) & (np.arange(frames) > 60)
    edges = np.abs(np.diff(pressed.astype(float), prepend=0.0)) > 0
    r = 0.12 * pressed[:, None] + np.zeros(cells)
    r += noise * (1.0 + r) ** 2 * np.random.default_rng(0).standard_normal((frames, cells))
    meter = meter_of(r, edges=np.repeat(edges[:, None], cells, axis=1))
    assert np.median(meter.at_rest) == pytest.approx(noise, rel=0.35)


@pytest.mark.parametrize("cells", [4, 64])
@pytest.mark.parametrize("factor", [3.0, 10.0])
def test_noise_that_rises_is_taken_up(cells: int, factor: float) -> None:
    """All differences are outliers then. Within ten seconds of a hundred frames the meter shows the new noise."""
    frames, noise = 1400, 0.001
    r = noise * np.random.default_rng(1).standard_normal((frames, cells))
    r[400:] *= factor
    assert np.median(meter_of(r).at_rest) == pytest.approx(factor * noise, rel=0.3)
