"""A law of the live path: a load that is held does not fade, whatever the codes of the converter do meanwhile.

While the paper's cell creeps under a held load, its readings step down from code to code. On a divider a step of one
reading moves the resistances of the whole column. No such step may be taken for a load that falls.
"""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.bench.boards import design
from ohmskin.cell import Cell
from ohmskin.circuits import adc_codes, scan_batch
from ohmskin.driver import CountReader
from ohmskin.driver._systematic import SystematicError

RATE_HZ, TARE_S, BEGIN_S, EDGE_S, HOLD_S, JUDGED_S = 25.0, 0.6, 1.0, 0.06, 32.0, 2.0
ROWS, COLUMNS = np.array([1, 3, 4, 6]), np.array([2, 5, 1, 4])
SHARES = np.linspace(0.1, 1.0, 12).reshape(3, 4).T.reshape(-1, 3).T
"""loads of full scale in each of three plays: their levels within a code all differ"""
FLOOR = 0.5
"""of its load, below which no held one of a fifth of full scale and more may be shown, even in the mean of a second"""


def held(
    circuit: str, bits: int, noise_mv: float, spread: float, *, compiled: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loads, pressures and stated deviations in kPa, each (frames, cells), of all plays side by side."""
    cell = Cell.example()
    board = design(circuit, "ground", "float", bits, cell.rest_resistance_ohm)
    time_s = np.arange(1.0, round((BEGIN_S + HOLD_S) * RATE_HZ) + 1) / RATE_HZ
    edge = np.clip((time_s - BEGIN_S) / EDGE_S, 0.0, 1.0)
    judged = time_s > BEGIN_S + JUDGED_S
    plays = []
    for play, shares in enumerate(SHARES):
        draw = np.random.default_rng(play)
        load = np.zeros((8, 8))
        load[ROWS, COLUMNS] = shares * cell.full_scale_kpa
        ohm = cell.forward((8, 8)).run(np.full(len(time_s), 1.0 / RATE_HZ), load * edge[:, None, None])
        ohm = ohm * np.exp(draw.normal(0.0, spread, (8, 8)))
        volts = scan_batch(board, ohm).volts
        codes = adc_codes(board, volts + 1e-3 * noise_mv * draw.standard_normal(volts.shape))
        read, systematic = CountReader(board), SystematicError(cell)
        tare = round(TARE_S * RATE_HZ)
        rest_ohm = np.mean([read(frame).resistance for frame in codes[:tare]], axis=0)
        estimator = cell.estimator((8, 8), rest_resistance_ohm=rest_ohm)
        if compiled and not estimator.compile():
            pytest.skip("needs numba")
        pressure, std = np.empty((2, len(codes), 8, 8))
        for n, frame in enumerate(codes[tare:], tare):
            reading = read(frame)
            if not estimator.resolved:
                estimator.resolve(reading.step_std, reading.resistance, reading.all_steps_std)
            pressure[n] = estimator.step(1.0 / RATE_HZ, reading.for_estimation)
            std[n] = systematic.take(reading, rest_known=True)(pressure[n], estimator.std_kpa**2)
        plays.append((edge[:, None] * load[ROWS, COLUMNS], pressure[:, ROWS, COLUMNS], std[:, ROWS, COLUMNS]))
    found = [np.concatenate(parts, axis=1)[judged] for parts in zip(*plays, strict=True)]
    return found[0], found[1], found[2]


@pytest.mark.parametrize("spread", [0.0, 0.1])
@pytest.mark.parametrize(
    ("circuit", "bits", "noise_mv"),
    [
        ("voltage-divider", 10, 0.1),
        ("voltage-divider", 10, 1.0),
        ("voltage-divider", 12, 0.1),
        ("inverting-amplifier", 8, 0.1),
        ("inverting-amplifier", 10, 1.0),
        ("inverting-amplifier", 12, 10.0),
    ],
)
def test_a_hold_does_not_fade(circuit: str, bits: int, noise_mv: float, spread: float) -> None:
    """For half a minute the load is within three stated deviations, and shown."""
    load, pressure, std = held(circuit, bits, noise_mv, spread, compiled=False)
    over = np.abs(pressure - load) / std
    assert np.mean(over < 2.0) > 0.94
    assert np.mean(over < 3.0) > 0.99
    second = round(RATE_HZ)
    whole = len(load) // second * second
    shown = (pressure[:whole] / load[:whole]).reshape(-1, second, load.shape[1]).mean(axis=1)
    heavy = load[-1] > 0.2 * Cell.example().full_scale_kpa
    assert shown[:, heavy].min() > FLOOR


def test_steps_of_coarse_dividers_leave_holds_within_what_is_stated() -> None:
    """An 8-bit divider hardly resolves a load: a step of each of its readings is a tenth of full scale."""
    load, pressure, std = held("voltage-divider", 8, 1.0, 0.1, compiled=False)
    over = np.abs(pressure - load) / std
    assert np.mean(over < 2.0) > 0.9
    assert np.mean(over < 3.0) > 0.99


def test_machine_code_doubts_falls_as_array_operations_do() -> None:
    """The same pressures and deviations, where steps of other readings count."""
    for one, other in zip(
        held("voltage-divider", 8, 1.0, 0.0, compiled=True),
        held("voltage-divider", 8, 1.0, 0.0, compiled=False),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)


def test_a_divider_tells_the_steps_of_all_its_readings() -> None:
    """By finite differences: a code more or less of each reading, and what that does to all resistances."""
    board = design("voltage-divider", "ground", "float", 12, 10e3)
    ohm = 10e3 * np.exp(np.random.default_rng(0).normal(0.0, 0.2, (8, 8)))
    codes = adc_codes(board, scan_batch(board, ohm[None]).volts[0])
    at = CountReader(board)(codes)
    square = np.zeros((8, 8))
    for place in np.ndindex(8, 8):
        more = codes.copy()
        more[place] += 1
        square += np.log(CountReader(board)(more).resistance / at.resistance) ** 2
    expected = np.sqrt(square / 12.0)
    np.testing.assert_allclose(at.all_steps_std, expected, rtol=0.3)
    assert np.all(at.all_steps_std >= at.step_std)
