"""Errors that no average lessens: unknown rest resistances and ADC steps, and what the driver says of them."""

from __future__ import annotations

import warnings
from itertools import islice
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, Wire, lossless, scene

from ohmskin.cell import Cell
from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.driver import CountReader, Frame, Measurement
from ohmskin.emulator import Board

SIDE = 10
FULL_KPA = 15.5
LOAD_KPA = 9.0
PRESSED = (4, 5)


def board(*, rest_percent: float, bits: int = 12, noise: float = 5e-4, **readout: Any) -> Board:
    """A skin of 10 x 10 cells, one of which is pressed from 0.5 to 2 s."""
    design = DESIGN | {
        "array": {"rows": SIDE, "columns": SIDE, "row_lead": 20.0},
        "adc": {"bits": bits, "range": [0.0, 3.3]},
        "readout": DESIGN["readout"] | readout,
        "sheet": {"pitch": 0.01, "electrode_width": 0.008},
    }
    spread = {"rest_percent": rest_percent, "seed": 11}
    load = [[0.5, 0.0], [0.52, LOAD_KPA], [2.0, LOAD_KPA], [2.02, 0.0]]
    return Board(
        scene(
            skin={"design": design, "spread": spread},
            board={"frame_rate": 100.0, "noise": noise},
            contact=[{"cells": [list(PRESSED)], "load_kpa": load}],
        )
    )


def settled(frames: list[Frame]) -> list[tuple[Frame, np.ndarray]]:
    """Frames whose load is not just changing, each with the true pressures in kPa."""
    result = []
    for frame in frames:
        assert frame.device_time is not None
        true = np.zeros((SIDE, SIDE))
        if 0.7 < frame.device_time < 1.9:
            true[PRESSED] = LOAD_KPA
        elif 0.45 < frame.device_time < 2.5:
            continue
        result.append((frame, true))
    return result


def deviations(frames: list[Frame]) -> np.ndarray:
    """Errors of all cells over their stated standard deviations."""
    return np.array([(frame.pressure - true) / frame.pressure_std for frame, true in settled(frames)])


@pytest.mark.parametrize("seen", [3.0, 0.5])
def test_without_a_tare_the_deviation_covers_the_spread_and_there_are_no_false_contacts(seen: float) -> None:
    with lossless(Wire(board(rest_percent=seen))) as skin:
        frames = list(islice(skin, 300))
        contacts = [frame.contacts for frame in frames]
        remark = skin.stats().remark
    error = np.abs(deviations(frames))
    assert np.mean(error > 3) < 0.01
    assert error.max() < 6
    held = [found for frame, found in zip(frames, contacts, strict=True) if 1.0 < (frame.device_time or 0) < 1.9]
    assert all([tuple(cell) for cell in found[0].cells.tolist()] == [PRESSED] for found in held)
    assert {len(found) for found in held} == {1}
    assert not any(contacts[:45])
    assert (remark is not None and "tare()" in remark) == (seen == 3.0)


def test_a_tare_takes_the_spread_out_of_the_deviation_and_undoing_it_brings_it_back() -> None:
    with lossless(Wire(board(rest_percent=3.0))) as skin:
        before = list(islice(skin, 60))[-1]
    with lossless(Wire(board(rest_percent=3.0))) as skin:
        skin.tare(20)
        tared = list(islice(skin, 15))[-1]
        skin.undo_tare()
        undone = list(islice(skin, 60))[-1]
    cell = Cell.example()
    kpa = 0.03 / (cell.model.gain_per_kpa)  # type: ignore[union-attr]  # of kind paper: r per kPa at equilibrium
    assert np.median(before.pressure_std) == pytest.approx(kpa, rel=0.4)
    assert np.median(tared.pressure_std) < 0.3 * kpa
    assert np.median(undone.pressure_std) > 0.6 * kpa


def test_cells_that_are_alike_cost_nothing() -> None:
    stds = []
    for tare in (False, True):
        with lossless(Wire(board(rest_percent=0.0))) as skin:
            if tare:
                skin.tare(20)
            stds.append(list(islice(skin, 45 if tare else 65))[-1].pressure_std)
            assert skin.stats().remark is None
    assert (stds[0] < stds[1] + 0.01 * FULL_KPA).all()


def test_cells_that_are_alike_do_not_differ_by_what_the_converter_rounds() -> None:
    """8 bits give all of them the same code, which stands for a resistance beside theirs."""
    with lossless(Wire(board(rest_percent=0.0, bits=8, noise=0.0, reference_resistance=4600.0))) as skin:
        frame, *later = islice(skin, 65)
        assert np.ptp(frame.counts) == 0
        assert skin.stats().remark is None
    assert 0.05 < np.median(np.abs(frame.pressure)) < 2 * np.median(later[-1].pressure_std) < 0.08 * FULL_KPA


@pytest.mark.parametrize("percent", [2.0, 6.0])
def test_a_spread_beyond_the_rounding_of_the_converter_is_stated(percent: float) -> None:
    coarse = board(rest_percent=percent, bits=8, noise=0.0, reference_resistance=4600.0)
    with lossless(Wire(coarse)) as skin:
        frames = list(islice(skin, 65))
        assert "without a tare" in (skin.stats().remark or "")
    assert np.mean(np.abs(deviations(frames)) > 2) < 0.08


def test_a_data_sheet_that_is_off_makes_no_contact_of_the_whole_skin() -> None:
    other = Cell.example().replace(rest_resistance_ohm=9000.0)
    with lossless(Wire(board(rest_percent=1.0)), cell=other) as skin:
        frames = list(islice(skin, 45))
        assert not any(frame.contacts for frame in frames)
        assert np.median(frames[-1].pressure) > 1  # 11 % of the resistance looks like this
        assert np.mean(np.abs(deviations(frames)) > 3) < 0.01


def test_the_least_spread_counts_since_loads_only_add_to_it() -> None:
    """A skin that is opened while most of it is pressed begins with a large doubt, and loses it when it is left."""
    pressed = [[i, j] for i in range(SIDE) for j in range(8)]
    load = [[0.0, LOAD_KPA], [0.5, LOAD_KPA], [0.55, 0.0], [20.0, 0.0], [20.1, LOAD_KPA]]
    design = DESIGN | {"array": {"rows": SIDE, "columns": SIDE, "row_lead": 20.0}}
    skin_table = {"design": design, "spread": {"rest_percent": 1.0}}
    contact = [{"cells": pressed, "load_kpa": load}]
    whole = Board(scene(skin=skin_table, board={"frame_rate": 20.0, "noise": 5e-4}, contact=contact))
    with lossless(Wire(whole)) as skin:
        frames = list(islice(skin, 430))
    std = [float(np.median(frame.pressure_std[:, 9])) for frame in frames]
    assert std[8] > 5.0
    assert std[395] < 1.0
    assert std[425] < 1.0


def test_steps_of_a_quiet_converter_are_in_the_deviation() -> None:
    with lossless(Wire(board(rest_percent=0.0, bits=8, noise=0.0)), accuracy=0.5) as skin:
        frames = list(islice(skin, 300))
    error = np.abs(deviations(frames))
    assert np.mean(error > 3) < 0.01
    assert error.max() < 5


@pytest.mark.parametrize(("noise", "ohms"), [(0.0, 32.5e3), (0.02, 31e3)])
def test_cells_of_which_nothing_is_known_leave_the_deviation_a_number(noise: float, ohms: float) -> None:
    """Saturated cells have an infinite uncertainty; much noise leaves no share of it to ADC steps."""
    with lossless(Wire(board(rest_percent=2.0, noise=noise, reference_resistance=ohms))) as skin:
        frames = list(islice(skin, 80))
    valid = frames[-1].valid
    assert 0 < valid.sum() < valid.size
    assert np.isfinite(frames[-1].pressure_std[valid]).all()


def test_the_driver_says_why_hardly_a_cell_is_valid() -> None:
    """A drive of the wrong sign: all readings stand at the low end of the range."""
    design = DESIGN | {"drive": {"voltage": 1.0}}
    with lossless(Wire(Board(scene(skin={"design": design}))), queue=100) as skin:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            list(islice(skin, 60))
        remark = skin.stats().remark
    assert remark is not None
    assert "no cell was valid" in remark
    assert "current" in remark or "limit" in remark


def test_a_press_that_noise_keeps_from_being_valid_is_felt() -> None:
    """Noise of 15 mV on readings of 150 mV, which fall under load: three deviations are more than half of a reading."""
    design = {
        "array": {"rows": SIDE, "columns": SIDE, "row_lead": 25.0},
        "drive": {"voltage": 3.3},
        "readout": {"circuit": "voltage-divider", "reference_resistance": 1000.0},
        "adc": {"bits": 8, "range": [0.0, 3.3]},
    }
    load = [[0.5, 0.0], [0.52, 14.0], [2.0, 14.0], [2.02, 0.0]]
    contact = [{"cells": [list(PRESSED)], "load_kpa": load}]
    noisy = Board(scene(skin={"design": design}, board={"frame_rate": 100.0, "noise": 0.0146}, contact=contact))
    with lossless(Wire(noisy)) as skin:
        skin.tare(20)
        frames = [frame for frame in islice(skin, 170) if 1.0 < (frame.device_time or 0.0) < 1.9]
    valid = np.mean([frame.valid[PRESSED] for frame in frames])
    pressure = np.array([frame.pressure[PRESSED] for frame in frames])
    std = np.array([frame.pressure_std[PRESSED] for frame in frames])
    assert valid < 0.5
    assert np.median(pressure) > 8.0
    assert np.mean(np.abs(pressure - 14.0) > 3.0 * std) < 0.02


def test_a_hard_press_on_a_divider_is_not_surer_than_the_noise_of_its_column() -> None:
    """Three cells pressed to a fifth of the load resistor take nearly all of the current of their column.

    What the others take, and so the sum of all, is known from small differences of noisy readings of 8 bits.
    """
    design = {
        "array": {"rows": 6, "columns": 10, "row_lead": 8.0, "column_lead": 12.0},
        "drive": {"voltage": 5.0},
        "readout": {"circuit": "voltage-divider", "reference_resistance": 4700.0},
        "adc": {"bits": 8, "range": [0.0, 5.0]},
    }
    cell = {
        "rest_resistance_ohm": 30e3,
        "full_scale_kpa": 40.0,
        "model": {"kind": "contact", "full_scale_resistance_ohm": 900.0},
    }
    load, pressed = 30.0, ([2, 3, 4], [6, 6, 6])
    pressure = [[0.0, 0.0], [0.5, 0.0], [0.55, load]]
    contact = [{"cells": np.transpose(pressed).tolist(), "load_kpa": pressure}]
    device = scene(skin={"design": design, "cell": cell}, board={"frame_rate": 100.0, "noise": 0.004}, contact=contact)
    with lossless(Wire(Board(device))) as skin:
        held = list(islice(skin, 400))[100:]
    error = np.array([(frame.pressure[pressed] - load) / frame.pressure_std[pressed] for frame in held])
    valid = np.array([frame.valid[pressed] for frame in held])
    assert valid.mean() > 0.9
    assert np.mean(np.abs(error[valid]) < 2) > 0.9
    assert np.mean(np.abs(error[valid]) < 3) >= 0.99
    assert np.abs(error[valid]).max() < 4


# ADC steps that scale whole columns of coarse dividers do not become loads


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
