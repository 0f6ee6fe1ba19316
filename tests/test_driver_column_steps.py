"""ADC steps that scale whole columns of coarse dividers do not become loads."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from boards import Wire, lossless, scene

from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.driver import CountReader, Measurement
from ohmskin.emulator import Board


def divider(size: int) -> Design:
    """8 bits, rows driven, a load of a third of the cells' resistance."""
    return Design.model_validate(
        {
            "array": {"rows": size, "columns": size, "row_lead": 25.0},
            "drive": {"voltage": 3.3},
            "readout": {"circuit": "voltage-divider", "reference_resistance": 4.7e3},
            "adc": {"bits": 8, "range": [0.0, 3.3]},
        }
    )


def test_a_finger_does_not_press_its_column() -> None:
    finger = {"bump": {"center": [6.0, 9.0], "sigma_cells": 0.8}, "load_kpa": [[0.0, 0.0], [0.8, 0.0], [0.9, 12.0]]}
    what = scene(skin={"design": divider(16).model_dump()}, contact=[finger], board={"frame_rate": 50.0, "noise": 1e-3})
    with lossless(Wire(Board(what, seed=1))) as skin:
        rest = skin.tare(20).rest_resistance_ohm
        frames = [frame for frame in islice(skin, 60) if (frame.device_time or 0.0) > 1.1]
    far = [row for row in range(16) if abs(row - 6) > 3]
    resistance = np.mean([frame.resistance[far, 9] for frame in frames], axis=0) / rest[far, 9]
    pressure = np.mean([frame.pressure for frame in frames], axis=0)
    assert np.abs(resistance - 1.0).max() > 0.1, "the whole column reads as pressed"
    assert np.abs(pressure[far, 9]).max() < 0.5
    assert 6.0 < pressure[6, 9] < 15.0, "the finger itself, of 12 kPa"


def last_of(board: Design, ohms: np.ndarray, noise_v: float, frames: int = 30) -> Measurement:
    """The last of several readings of cells that hold still."""
    draw, read, volts = np.random.default_rng(1), CountReader(board), scan(board, ohms).volts
    for _ in range(frames):
        reading = read(adc_codes(board, volts + draw.normal(scale=noise_v, size=volts.shape)))
    return reading


@pytest.mark.parametrize(("size", "rest_ohm"), [(16, 14e3), (16, 30e3), (32, 30e3)])
def test_what_half_a_step_of_all_other_readings_makes_of_a_column_is_their_sum(size: int, rest_ohm: float) -> None:
    board, ohms = divider(size), np.full((size, size), rest_ohm)
    codes = adc_codes(board, scan(board, ohms).volts)
    told = last_of(board, ohms, 0.0)
    steps = np.abs(told.column_half_step / told.conductance).mean(axis=0) * (size - 1) / np.sqrt(size) / 2.0
    left = 1.0 - (codes + 0.5).sum(axis=0) / 256.0  # of the drive, in which that sum is missing
    np.testing.assert_allclose(steps, 0.5 * (size - 1) / 256.0 / left, rtol=0.15)


def test_noise_of_a_step_leaves_no_steps() -> None:
    told = last_of(divider(16), np.full((16, 16), 1e4), 3.3 / 256)
    assert np.abs(told.column_half_step / told.column_std).max() < 0.01
