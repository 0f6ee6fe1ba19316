"""Calibrations that several test modules look at: each is made once in a run of the tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from together import once

from ohmskin.bench import _materials as independent
from ohmskin.cell import CalibrationResult, Cell, Recording, calibrate, checked_recording
from ohmskin.cell.identification import _protocol as protocol

EXAMPLE = Cell.example()
DT = 0.1
FULL = EXAMPLE.full_scale_kpa


def sense(cell: Cell, load: np.ndarray, dt: float = DT) -> np.ndarray:
    """Resistance (n,) of a cell under normalised loads (n,)."""
    return cell.forward(()).run(np.full(len(load), dt), cell.full_scale_kpa * load)


def protocol_recording(cell: Cell, noise: float, seed: int = 0) -> Recording:
    """The calibration protocol on a cell, with noise relative to the reading."""
    time, load = protocol.protocol_load(DT)
    clean = sense(cell, load)
    return checked_recording(
        time, FULL * load, clean * (1 + noise * np.random.default_rng(seed).standard_normal(len(load)))
    )


def resistance(load: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ohm (n,): half from relays, half from fractional creep, saturating, with noise relative to itself."""
    deformed = 0.5 * independent.preisach(load, rng) + 0.5 * independent.fractional_creep(load, DT)
    r = 0.9 * np.tanh(1.2 * deformed) / np.tanh(1.2)
    return np.asarray(1e4 * (1 + r) * (1 + 0.002 * rng.standard_normal(len(load))))


def exactly(cell: Cell, name: str | None, time: np.ndarray, read: np.ndarray, **options: float) -> np.ndarray:
    """kPa (n, *shape) of readings (n, *shape) taken as free of noise."""
    estimator = cell.estimator(read.shape[1:], name, noise=0.0, **options)
    steps = np.diff(time, prepend=time[0])
    return np.stack([estimator.step(float(dt), r) for dt, r in zip(steps, read, strict=True)])


@once
def paper() -> CalibrationResult:
    """The example cell, from the 280 s protocol with 0.5 % noise."""
    return calibrate(protocol_recording(EXAMPLE, 0.005))


@dataclass(frozen=True)
class Unknown:
    """A material that no model describes: relays and fractional creep."""

    found: CalibrationResult
    load: np.ndarray
    read: np.ndarray
    learned: int
    """samples that it was calibrated on"""

    @property
    def time(self) -> np.ndarray:
        return DT * np.arange(len(self.load))


@once
def unknown() -> Unknown:
    """Random presses: half to learn from, then loads and readings to judge by."""
    rng = np.random.default_rng(3)
    load = independent.presses(rng, 900, DT, holds=True)
    read = resistance(load, rng)
    load, read = load[-6000:], read[-6000:]  # conditioned before
    part = len(load) // 2
    found = calibrate(checked_recording(DT * np.arange(part), FULL * load[:part], read[:part]), full_scale_kpa=FULL)
    return Unknown(found, load, read, part)


@once
def creeping() -> Unknown:
    """The protocol to learn from, ten minutes at rest, then presses: creep goes on for longer than was recorded."""
    rng = np.random.default_rng(1)
    _, pressed = protocol.protocol_load(DT)
    later = [independent.presses(rng, 200, DT, holds=holds) for holds in (True, False)]
    load = np.concatenate([pressed, np.zeros(round(600 / DT)), *later])
    read = resistance(load, rng)
    part = len(pressed)
    found = calibrate(checked_recording(DT * np.arange(part), FULL * load[:part], read[:part]), full_scale_kpa=FULL)
    return Unknown(found, load, read, part)
