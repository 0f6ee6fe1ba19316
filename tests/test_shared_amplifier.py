"""One amplifier behind a switch in time: settling and noise against equations of the whole circuit, written here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.constants import Boltzmann
from scipy.integrate import quad
from scipy.linalg import expm

from ohmskin.circuits import Design, Settling, noise, scan
from ohmskin.errors import InputError

Floats = NDArray[np.float64]
ROW_LEAD, COLUMN_LEAD, REFERENCE, DRIVE, OFFSET, BIAS, LEVEL = 70.0, 120.0, 2e3, -1.0, 2e-3, 3e-9, 0.5
FARAD, FEEDBACK_FARAD, HERTZ, GAIN = 2e-9, 0.5e-9, 1e6, 1e4
CELLS = np.array([[700.0, 5e3, 2e3], [3e3, 900.0, 4e4]])


def shared_board(idle: str, rows: str, **readout: Any) -> Design:
    parts = {
        "circuit": "inverting-amplifier",
        "columns": "multiplexed",
        "idle_columns": idle,
        "reference_resistance": REFERENCE,
        "reference_voltage": LEVEL,
        "open_loop_gain": GAIN,
        "gain_bandwidth": HERTZ,
        "offset_voltage": OFFSET,
        "bias_current": BIAS,
        "column_capacitance": FARAD,
        "feedback_capacitance": FEEDBACK_FARAD,
    }
    pull = {"idle_row_resistance": 1e4} if rows == "pull" else {}
    return Design.model_validate(
        {
            "array": {"rows": 2, "columns": 3, "row_lead": ROW_LEAD, "column_lead": COLUMN_LEAD},
            "drive": {"voltage": DRIVE, "idle_rows": rows, **pull},
            "readout": parts | readout,
        }
    )


def grid(row: int, rows: str) -> tuple[Floats, Floats]:
    """Conductances (3, 3) and currents (3,) that the column ends see: rows and crosspoints eliminated (Schur)."""
    count = 2 + 3 + 3  # rows, columns at the cells, columns at their ends
    matrix, current = np.zeros((count, count)), np.zeros(count)
    branches = [(i, 2 + j, 1 / ohm) for (i, j), ohm in np.ndenumerate(CELLS)]
    branches += [(2 + j, 5 + j, 1 / COLUMN_LEAD) for j in range(3)]
    for a, b, g in branches:
        matrix[[a, b], [a, b]] += g
        matrix[[a, b], [b, a]] -= g
    for i in range(2):
        matrix[i, i] += 1 / ROW_LEAD if i == row or rows == "ground" else 0.0
        matrix[i, i] += 1e-4 if rows == "pull" else 0.0
    current[row] = DRIVE / ROW_LEAD
    inner, ends = slice(0, 5), slice(5, 8)
    solved = np.linalg.solve(matrix[inner, inner], np.column_stack([matrix[inner, ends], current[inner]]))
    return matrix[ends, ends] - matrix[ends, inner] @ solved[:, :3], -matrix[ends, inner] @ solved[:, 3]


def simulated(idle: str, rows: str, period: float, frames: int) -> Floats:
    """Samples (2, 3) in V of the last frame, each share of a step by the exponential of its equations."""
    omega = 2 * np.pi * HERTZ
    ends, before, out, samples = np.zeros(3), 0.0, 0.0, np.zeros((2, 3))
    for _ in range(frames):
        for row in range(2):
            conductance, current = grid(row, rows)
            for k in range(3):
                others = [j for j in range(3) if j != k]
                if idle == "ground":
                    ends[others] = 0.0
                # The feedback capacitor joins the line of column k: charge is shared, the output stays.
                joint = (FARAD * ends[k] + FEEDBACK_FARAD * before) / (FARAD + FEEDBACK_FARAD)
                ends[k] = joint

                def slope(state: Floats, k: int = k, matrix: Floats = conductance, drive: Floats = current) -> Floats:
                    u, v = state[:3].copy(), state[3]
                    if idle == "ground":
                        u[[j for j in range(3) if j != k]] = 0.0
                    leaving = matrix @ u - drive
                    if idle == "load":
                        leaving += np.where(np.arange(3) == k, 0.0, u / REFERENCE)
                    change = np.zeros(4)
                    change[3] = omega * (OFFSET - u[k] - (v + LEVEL) / GAIN)
                    change[:3] = -leaving / FARAD if idle != "ground" else 0.0
                    into = -leaving[k] - (u[k] - v) / REFERENCE - BIAS
                    change[k] = (into + FEEDBACK_FARAD * change[3]) / (FARAD + FEEDBACK_FARAD)
                    return change

                constant, affine = slope(np.zeros(4)), np.zeros((5, 5))
                affine[:4, :4] = np.column_stack([slope(unit) - constant for unit in np.eye(4)])
                affine[:4, 4] = constant
                *ends, out, _ = expm(affine * period / 3) @ [*ends, out, 1.0]
                ends = np.array(ends)
                before, samples[row, k] = ends[k], out
    return samples + LEVEL


@pytest.mark.parametrize(
    ("idle", "rows"), [("float", "ground"), ("ground", "ground"), ("load", "pull"), ("float", "float")]
)
def test_samples_of_a_repeated_scan_are_those_of_the_circuit(idle: str, rows: str) -> None:
    period = 12e-6
    settling = Settling(shared_board(idle, rows), CELLS)
    right = simulated(idle, rows, period, 20)
    assert np.abs(right - settling.settled).max() > 1e-3  # not settled at all
    np.testing.assert_allclose(settling.sampled(period), right, rtol=1e-9)


@pytest.mark.parametrize("idle", ["float", "ground", "load"])
def test_noise_is_the_integral_of_its_spectrum(idle: str) -> None:
    """Reading [1, 2]: nodal analysis at each frequency, with the spectral densities of all sources."""
    kelvin, volt_density, ampere_density = 300.0, 30e-9, 1e-12
    design = shared_board(idle, "ground", voltage_noise=volt_density, current_noise=ampere_density, temperature=kelvin)
    conductance, _ = grid(1, "ground")
    k, others = 2, [0, 1]
    matrix = conductance.copy()
    if idle == "load":
        matrix[others, others] += 1 / REFERENCE

    def density(log_hertz: float) -> float:  # V^2/Hz times dHz/dlog
        s = 2j * np.pi * np.exp(log_hertz)
        nodes = [k] if idle == "ground" else [*others, k]
        seen = (matrix + s * FARAD * np.eye(3))[np.ix_(nodes, nodes)]
        back = 1 / REFERENCE + s * FEEDBACK_FARAD
        whole = np.zeros((len(nodes) + 1, len(nodes) + 1), dtype=complex)
        whole[:-1, :-1] = seen
        whole[-2, -2:] += back, -back
        whole[-1, -2:] = 1.0, 1 / GAIN + s / (2 * np.pi * HERTZ)
        gains = np.linalg.inv(whole)[-1]
        currents = 4 * Boltzmann * kelvin * matrix[np.ix_(nodes, nodes)]
        currents[-1, -1] += 4 * Boltzmann * kelvin / REFERENCE + ampere_density**2
        power = abs(gains[-1]) ** 2 * volt_density**2 + (gains[:-1] @ currents @ gains[:-1].conj()).real
        return float(power * np.exp(log_hertz))

    variance = quad(density, np.log(1e-1), np.log(1e10), limit=400, epsabs=0.0, epsrel=1e-8)[0]
    np.testing.assert_allclose(noise(design, CELLS).before_adc[1, 2], np.sqrt(variance), rtol=1e-4)


def test_an_amplifier_of_infinite_bandwidth_has_no_finite_noise() -> None:
    with pytest.raises(InputError, match=r"give readout\.gain_bandwidth"):
        noise(shared_board("float", "ground", voltage_noise=3e-8, gain_bandwidth=np.inf), CELLS)


@pytest.mark.parametrize("idle", ["float", "ground"])
def test_a_faster_amplifier_approaches_the_one_without_poles(idle: str) -> None:
    fast, ideal = (
        Settling(shared_board(idle, "ground", gain_bandwidth=hertz), CELLS).sampled(9e-6) for hertz in (1e11, np.inf)
    )
    np.testing.assert_allclose(fast, ideal, atol=1e-4)
    assert np.abs(ideal - scan(shared_board(idle, "ground"), CELLS).volts).max() > 1e-2
