"""Noise against closed forms and ngspice's noise analysis."""

from __future__ import annotations

from math import inf, pi, sqrt
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from needs import need
from numpy.typing import NDArray
from scipy.constants import Boltzmann
from scipy.integrate import quad
from scipy.linalg import expm

from ohmskin.circuits import Adc, Design, Settling, adc_codes, noise, scan, volts_of_codes
from ohmskin.circuits.spice import command_available, run_command
from ohmskin.errors import InputError

CELLS = np.array([[1e4, 2e4], [3e4, 1.5e4], [np.inf, 1e4]])
SAMPLER = {"sampling_capacitance": 2e-11, "switch_resistance": 1e4}
GAIN = 1 + 2e4 * np.array([1 / 1e4 + 1 / 3e4, 1 / 2e4 + 1 / 1.5e4 + 1 / 1e4])


def board(
    adc: dict[str, float] | None = None, *, idle_rows: str = "ground", lead: float = 0.0, **readout: Any
) -> Design:
    design = amplifier(*CELLS.shape, lead=lead, **{"reference_resistance": 2e4, "gain_bandwidth": 1e6} | readout)
    return design.replace(
        drive={"idle_rows": idle_rows},
        adc=None if adc is None else Adc.model_validate({"bits": 12, "range": (0.0, 3.3)} | adc),
    )


def test_nothing_is_noisy_by_default() -> None:
    result = noise(board(), CELLS)
    assert result.parts == {}
    assert (result.volts == 0).all()


def test_one_pole() -> None:
    """Noise gain over a bandwidth of pi/2 GBW/gain; Rref and the grid's noise currents through Rref."""
    result = noise(board(voltage_noise=3e-8, current_noise=1e-12, temperature=300.0), CELLS)
    bandwidth = pi / 2 * 1e6 / GAIN
    thermal = 4 * Boltzmann * 300.0
    expected = {
        "amplifier voltage": 3e-8 * GAIN * np.sqrt(bandwidth),
        "amplifier current": 1e-12 * 2e4 * np.sqrt(bandwidth),
        "grid": np.sqrt(thermal * (GAIN - 1) / 2e4 * bandwidth) * 2e4,
        "reference resistor": np.sqrt(thermal * 2e4 * bandwidth),
    }
    assert result.parts.keys() == expected.keys()
    for name, part in expected.items():
        np.testing.assert_allclose(result.parts[name], np.tile(part, (3, 1)), rtol=1e-9, err_msg=name)
    total = np.sqrt(sum(part**2 for part in expected.values()))
    np.testing.assert_allclose(result.volts, np.tile(total, (3, 1)), rtol=1e-9)


def test_a_feedback_capacitor_alone_holds_kt_over_c() -> None:
    """An ideal amplifier: Rref's noise on Cf is kT/C, whatever Rref; the grid adds its share of conductance."""
    design = board(gain_bandwidth=inf, feedback_capacitance=1e-11, temperature=300.0)
    parts = noise(design, CELLS).parts
    np.testing.assert_allclose(parts["reference resistor"], sqrt(Boltzmann * 300.0 / 1e-11), rtol=1e-9)
    np.testing.assert_allclose(parts["grid"][0], np.sqrt(Boltzmann * 300.0 / 1e-11 * (GAIN - 1)), rtol=1e-9)


def test_the_sampler_limits_an_ideal_amplifier() -> None:
    """White noise through one RC: a bandwidth of 1/(4 RC), and kT/C of its own."""
    design = board(SAMPLER, gain_bandwidth=inf, voltage_noise=3e-8, temperature=300.0)
    parts = noise(design, CELLS).parts
    np.testing.assert_allclose(parts["amplifier voltage"][0], 3e-8 * GAIN * sqrt(1 / (4 * 2e-7)), rtol=1e-9)
    np.testing.assert_allclose(parts["sampling"], sqrt(Boltzmann * 300.0 / 2e-11), rtol=1e-12)


CASES: dict[str, dict[str, Any]] = {
    "gain-bandwidth": {},
    "finite gain, leads": {"open_loop_gain": 1e3, "lead": 200.0},
    "peaking": {"column_capacitance": 1e-9, "lead": 70.0},
    "compensated": {"column_capacitance": 1e-9, "feedback_capacitance": 2e-11, "lead": 70.0},
    "floating rows": {"idle_rows": "float", "lead": 70.0},
    "sampler": {"adc": SAMPLER, "column_capacitance": 1e-10, "lead": 70.0},
}
SOURCES = {"voltage_noise": 3e-8, "current_noise": 2e-12, "temperature": 300.0}


def by_ngspice(design: Design, row: int, column: int) -> float:
    """Total output noise in V: every source is a resistor, which is what ngspice takes noise from."""
    part, (rows, columns) = design.readout, CELLS.shape
    cards = ["* noise", "Vin in 0 AC 1"]
    for i in range(rows):
        drive = "in" if i == row else "0"
        if i == row or design.drive.idle_rows == "ground":
            cards.append(f"Rlead{i} {drive} r{i} {design.array.row_lead or 1e-6!r}")
        cards += [f"R{i}{j} r{i} c{j} {float(CELLS[i, j])!r}" for j in range(columns) if CELLS[i, j] < inf]
    for j in range(columns):
        cards += [
            f"Rcol{j} c{j} m{j} {design.array.column_lead or 1e-6!r}",
            f"Rref{j} m{j} o{j} {part.reference_resistance!r}",
            f"Rvoltage{j} p{j} 0 {part.voltage_noise**2 / (4 * Boltzmann * 300.0)!r}",
            f"Rcurrent{j} k{j} 0 1000",
            f"Gcurrent{j} m{j} 0 k{j} 0 {part.current_noise / sqrt(4 * Boltzmann * 300.0 * 1000)!r}",
            f"Gamp{j} 0 a{j} p{j} m{j} 1",
            f"Camp{j} a{j} 0 {1 / (2 * pi * part.gain_bandwidth)!r}",
            f"Gloss{j} a{j} 0 a{j} 0 {1 / part.open_loop_gain!r}",
            f"Eamp{j} o{j} 0 a{j} 0 1",
        ]
        cards += [f"Ccol{j} m{j} 0 {part.column_capacitance!r}"] if part.column_capacitance else []
        cards += [f"Cref{j} m{j} o{j} {part.feedback_capacitance!r}"] if part.feedback_capacitance else []
        if design.adc:
            cards += [
                f"Rsw{j} o{j} q{j} {design.adc.switch_resistance!r}",
                f"Cs{j} q{j} 0 {design.adc.sampling_capacitance!r}",
            ]
    cards += [
        ".options temp=26.85 tnom=26.85",
        f".noise v({'q' if design.adc else 'o'}{column}) Vin dec 300 1 1e11",
        ".end",
    ]
    found = run_command("\n".join(cards))
    return float(np.sqrt(np.trapezoid(np.abs(found["onoise_spectrum"]) ** 2, np.abs(found["frequency"]))))


@pytest.mark.parametrize("name", CASES)
def test_against_ngspice(name: str) -> None:
    need(command_available())
    design = board(**CASES[name], **SOURCES)
    result = noise(design, CELLS).before_adc
    for row, column in ((0, 0), (1, 1), (0, 1)):
        assert by_ngspice(design, row, column) == pytest.approx(result[row, column], rel=2e-3)


def test_samples_scatter_as_promised_and_repeat_with_their_seed() -> None:
    volts = np.linspace(0.1, 3, 6).reshape(3, 2)
    result = noise(board({}, **SOURCES), CELLS)
    samples = result.samples(volts, 20_000, seed=5)
    np.testing.assert_allclose(samples.mean(axis=0), volts, atol=5 * result.volts.max() / sqrt(20_000))
    np.testing.assert_allclose(samples.std(axis=0), result.before_adc, rtol=0.03)
    assert (samples == result.samples(volts, 20_000, seed=5)).all()
    assert (samples != result.samples(volts, 20_000, seed=6)).any()
    with pytest.raises(InputError, match="shape"):
        result.samples(volts[0], 1, seed=5)


def test_quantisation_is_what_the_converter_does() -> None:
    design = board({"bits": 8})
    volts = np.random.default_rng(2).uniform(0, 3.3, 100_000)
    error = volts_of_codes(design, adc_codes(design, volts)) - volts
    np.testing.assert_allclose(noise(design, CELLS).volts, error.std(), rtol=0.01)


def test_noise_without_a_bandwidth_is_refused() -> None:
    with pytest.raises(InputError, match="amplifier voltage has no bandwidth limit"):
        noise(board(gain_bandwidth=inf, voltage_noise=1e-8), CELLS)
    with pytest.raises(InputError, match="grid has no bandwidth limit"):
        noise(board(gain_bandwidth=inf, temperature=300.0), CELLS)
    with pytest.raises(InputError, match="inverting-amplifier"):
        noise(board().with_circuit("voltage-feedback"), CELLS)
    warm = divider(3, 2)
    warm = warm.replace(readout={"temperature": 300.0})
    with pytest.raises(InputError, match=r"resistors has no bandwidth limit.*sampling_capacitance"):
        noise(warm, CELLS)


def test_a_divider_holds_kt_over_c_and_its_step() -> None:
    """Against the noise currents of its resistors through the one pole that they make with the capacitor."""
    design = divider(1, 1)
    design = design.replace(
        readout={"temperature": 300.0}, adc=Adc.model_validate({"bits": 12, "range": (0.0, 3.3)} | SAMPLER)
    )
    parts = noise(design, [[4e3]]).parts
    ohms = 1 / (1 / 4e3 + 1 / 1e3) + SAMPLER["switch_resistance"]
    bandwidth = 1 / (4 * ohms * SAMPLER["sampling_capacitance"])
    np.testing.assert_allclose(parts["sampling"], sqrt(4 * Boltzmann * 300.0 * ohms * bandwidth), rtol=1e-12)
    np.testing.assert_allclose(parts["quantisation"], 3.3 / 4096 / sqrt(12), rtol=1e-12)
    assert parts.keys() == {"sampling", "quantisation"}


def test_open_columns_have_no_grid_noise() -> None:
    parts = noise(board(**SOURCES), np.full((3, 2), inf)).parts
    assert "grid" not in parts
    assert (parts["reference resistor"] > 0).all()


def test_the_sampling_capacitor_is_as_noisy_however_small_its_switch() -> None:
    """kT/C (Nyquist): the resistance sets the bandwidth, not the variance."""
    rms = [
        noise(board(temperature=300.0, adc={"sampling_capacitance": 5e-12, "switch_resistance": ohms}), CELLS)
        .parts["sampling"]
        .max()
        for ohms in (0.0, 1e-3, 1e3)
    ]
    np.testing.assert_allclose(rms, sqrt(Boltzmann * 300.0 / 5e-12), rtol=1e-12)


# One amplifier behind a switch in time: settling and noise against equations of the whole circuit, written here


Floats = NDArray[np.float64]
ROW_LEAD, COLUMN_LEAD, REFERENCE, DRIVE, OFFSET, BIAS, LEVEL = 70.0, 120.0, 2e3, -1.0, 2e-3, 3e-9, 0.5
FARAD, FEEDBACK_FARAD, HERTZ, SHARED_GAIN = 2e-9, 0.5e-9, 1e6, 1e4
SHARED_CELLS = np.array([[700.0, 5e3, 2e3], [3e3, 900.0, 4e4]])


def shared_board(idle: str, rows: str, **readout: Any) -> Design:
    parts = {
        "circuit": "inverting-amplifier",
        "columns": "multiplexed",
        "idle_columns": idle,
        "reference_resistance": REFERENCE,
        "reference_voltage": LEVEL,
        "open_loop_gain": SHARED_GAIN,
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
    branches = [(i, 2 + j, 1 / ohm) for (i, j), ohm in np.ndenumerate(SHARED_CELLS)]
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
                    change[3] = omega * (OFFSET - u[k] - (v + LEVEL) / SHARED_GAIN)
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
    settling = Settling(shared_board(idle, rows), SHARED_CELLS)
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
        whole[-1, -2:] = 1.0, 1 / SHARED_GAIN + s / (2 * np.pi * HERTZ)
        gains = np.linalg.inv(whole)[-1]
        currents = 4 * Boltzmann * kelvin * matrix[np.ix_(nodes, nodes)]
        currents[-1, -1] += 4 * Boltzmann * kelvin / REFERENCE + ampere_density**2
        power = abs(gains[-1]) ** 2 * volt_density**2 + (gains[:-1] @ currents @ gains[:-1].conj()).real
        return float(power * np.exp(log_hertz))

    variance = quad(density, np.log(1e-1), np.log(1e10), limit=400, epsabs=0.0, epsrel=1e-8)[0]
    np.testing.assert_allclose(noise(design, SHARED_CELLS).before_adc[1, 2], np.sqrt(variance), rtol=1e-4)


def test_an_amplifier_of_infinite_bandwidth_has_no_finite_noise() -> None:
    with pytest.raises(InputError, match=r"give readout\.gain_bandwidth"):
        noise(shared_board("float", "ground", voltage_noise=3e-8, gain_bandwidth=np.inf), SHARED_CELLS)


@pytest.mark.parametrize("idle", ["float", "ground"])
def test_a_faster_amplifier_approaches_the_one_without_poles(idle: str) -> None:
    fast, ideal = (
        Settling(shared_board(idle, "ground", gain_bandwidth=hertz), SHARED_CELLS).sampled(9e-6)
        for hertz in (1e11, np.inf)
    )
    np.testing.assert_allclose(fast, ideal, atol=1e-4)
    assert np.abs(ideal - scan(shared_board(idle, "ground"), SHARED_CELLS).volts).max() > 1e-2
