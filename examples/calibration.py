"""Error before and after a calibration per cell, on emulated skins whose cells differ.

Each skin is calibrated by presses with two loads, one cell at a time. Then it is pressed otherwise: two fingertips
wander over it with loads that swing. The table has the error of the pressure where a cell is pressed, with the data
sheet alone, with a tare, and with the calibration.

    python examples/calibration.py [--json]
"""

from __future__ import annotations

import json
import sys
import tempfile
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ohmskin.calibration import Plan, Watch, calibrate_cells
from ohmskin.driver import Calibration, Skin
from ohmskin.emulator import PtyPort, Scene, running

LOADS_KPA = (5.0, 12.0)
FRAME_RATE = 20.0
PRESS_S, HOLD_S, REST_S = 6.0, 3.5, 2.0
TEST_S = 40.0
TARE_FRAMES = 20
PRESSED_KPA = 0.5
SPREAD = {"rest_percent": 10.0, "sensitivity_percent": 20.0, "seed": 11}
PROTOTYPE = str(Path(__file__).parents[1] / "verification" / "prototype.toml")
DIVIDER = {
    "array": {"rows": 4, "columns": 3, "row_segment": 1.0, "column_segment": 1.0, "row_lead": 40.0},
    "drive": {"voltage": 3.3, "idle_rows": "ground"},
    "readout": {"circuit": "voltage-divider", "reference_resistance": 10e3},
    "adc": {"bits": 8, "range": [0.0, 3.3]},
}
"""four rows by three columns, read by the 8-bit converter of a small controller"""
AMPLIFIERS = {
    "array": {
        "rows": 8,
        "columns": 8,
        "row_segment": 0.5,
        "column_segment": 0.5,
        "row_lead": 70.0,
        "column_lead": 25.0,
    },
    "drive": {"voltage": -1.0},
    "readout": {
        "circuit": "inverting-amplifier",
        "reference_resistance": 20e3,
        "open_loop_gain": 1e5,
        "supply": [0.0, 3.3],
    },
    "adc": {"bits": 12, "range": [0.0, 3.3]},
}
SKINS: dict[str, tuple[Any, tuple[int, int], float]] = {
    "4 x 4 prototype, 12 bits, 0.5 mV noise": (PROTOTYPE, (4, 4), 5e-4),
    "8 x 8 amplifiers, 12 bits, 0.5 mV noise": (AMPLIFIERS, (8, 8), 5e-4),
    "4 x 3 divider, 8 bits, 4 mV noise": (DIVIDER, (4, 3), 4e-3),
}
"""design, rows and columns, noise in V"""


def scene_of(design: Any, noise: float, **tables: Any) -> Scene:
    """The skin under the loads that ``tables`` give it."""
    skin = {"design": design, "spread": SPREAD}
    board = {"frame_rate": FRAME_RATE, "noise": noise}
    return Scene.from_tables({"skin": skin, "board": board, **tables}, source="scene", directory=Path())


def calibration_movie(plan: Plan, path: Path) -> float:
    """Write a movie of a person who follows the plan; how long it lasts in s."""
    rows, columns = plan.shape
    times, frames = [0.0], [np.zeros(rows * columns)]
    at = 3.0
    for load in plan.loads_kpa:
        for cells in plan.targets:
            pressed = np.zeros(rows * columns)
            pressed[cells] = load
            times += [at, at + 0.3, at + 0.5 + HOLD_S, at + 0.7 + HOLD_S]
            frames += [0 * pressed, pressed, pressed, 0 * pressed]
            at += PRESS_S
    np.savez(path, time_s=times, pressure_kpa=np.reshape(frames, (-1, rows, columns)))
    return at


def calibrated(scene: Scene, plan: Plan, seconds: float) -> Calibration:
    """Calibrate the emulated skin."""
    port = PtyPort()
    with running(scene, port, clock="fast"), Skin.open(port.name, delivery="lossless") as skin:
        assert skin.cell is not None
        watch = Watch(skin.cell, plan, hold_s=HOLD_S, rest_s=REST_S)
        for frame in islice(skin, int(seconds * FRAME_RATE)):
            watch.feed(frame.device_time or 0.0, np.where(frame.valid, frame.resistance, np.nan))
        assert watch.rest is not None
        verdict = calibrate_cells(skin.cell, watch.rest, watch.presses)
        return verdict.calibration(skin.design, skin.cell, skin.serial_number)


def wandering_fingers(shape: tuple[int, int]) -> list[dict[str, Any]]:
    """Two contacts that no calibration has seen: places between cells, loads that swing."""
    rng = np.random.default_rng(7)
    contacts = []
    for frequency in (0.37, 0.53):
        places = rng.uniform(0.0, np.array(shape) - 1.0, (16, 2))
        times = np.linspace(3.0, TEST_S, len(places))
        path = [[float(time), *map(float, place)] for time, place in zip(times, places, strict=True)]
        load = {"mean_kpa": 6.0, "amplitude_kpa": 5.0, "frequency_hz": frequency, "start_s": 3.0}
        contacts.append({"bump": {"sigma_cells": 0.8}, "path_cells": path, "sine": load})
    return contacts


def errors(scene: Scene, folder: Path, *, tare: bool, calibration: Calibration | None) -> dict[str, float]:
    """Errors under loads that no calibration has seen."""
    port, truth = PtyPort(), folder / "truth.npz"
    found: list[tuple[int, NDArray[np.float64], NDArray[np.float64]]] = []
    with (
        running(scene, port, clock="fast", truth=truth),
        Skin.open(port.name, delivery="lossless", calibration=calibration) as skin,
    ):
        if tare:
            skin.tare(TARE_FRAMES)
        for frame in islice(skin, int(TEST_S * FRAME_RATE) - TARE_FRAMES):
            assert frame.sequence is not None
            valid = frame.valid
            found.append((frame.sequence, np.where(valid, frame.pressure, np.nan), frame.pressure_std))
    with np.load(truth) as file:
        true = dict(zip(file["sequence"].tolist(), file["pressure_kpa"], strict=True))
    expected = np.array([true[sequence] for sequence, _, _ in found])
    error = np.array([pressure for _, pressure, _ in found]) - expected
    std = np.array([deviation for _, _, deviation in found])
    counted = (expected > PRESSED_KPA) & np.isfinite(error)
    squares = np.where(counted, error**2, 0.0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
    loads = np.where(counted, expected**2, 0.0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
    share = np.sqrt(squares / np.where(loads > 0, loads, np.inf))
    return {
        "rmse_kpa": float(np.sqrt((error[counted] ** 2).mean())),
        "worst_cell_kpa": float(np.sqrt(squares.max())),
        "worst_cell_percent": float(100 * share.max()),
        "within_two_std_percent": float(100 * (np.abs(error) <= 2 * std)[counted].mean()),
        "not_valid_percent": float(100 * (~np.isfinite(error))[expected > PRESSED_KPA].mean()),
    }


def main(arguments: list[str]) -> None:
    """Print the table, or its numbers as JSON."""
    results: dict[str, dict[str, dict[str, float]]] = {}
    for name, (design, shape, noise) in SKINS.items():
        with tempfile.TemporaryDirectory() as folder_name:
            folder = Path(folder_name)
            plan = Plan.make(shape, "each", LOADS_KPA)
            seconds = calibration_movie(plan, folder / "movie.npz")
            movie = {"file": str(folder / "movie.npz")}
            calibration = calibrated(scene_of(design, noise, movie=movie), plan, seconds)
            test = scene_of(design, noise, contact=wandering_fingers(shape))
            results[name] = {
                "data sheet only": errors(test, folder, tare=False, calibration=None),
                "tare": errors(test, folder, tare=True, calibration=None),
                "calibration": errors(test, folder, tare=False, calibration=calibration),
            }
    if "--json" in arguments:
        print(json.dumps(results))
        return
    print("| skin | with | RMSE, kPa | worst cell, kPa rms | worst cell, % of its load | within 2 std, % |")
    print("|---|---|---|---|---|---|")
    for name, rows in results.items():
        for known, found in rows.items():
            print(
                f"| {name} | {known} | {found['rmse_kpa']:.2f} | {found['worst_cell_kpa']:.2f} | "
                f"{found['worst_cell_percent']:.0f} | {found['within_two_std_percent']:.0f} |"
            )


if __name__ == "__main__":
    main(sys.argv[1:])
