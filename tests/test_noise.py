"""Noise against closed forms and ngspice's noise analysis."""

from __future__ import annotations

from math import inf, pi, sqrt
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from needs import need
from scipy.constants import Boltzmann

from ohmskin.circuits import Adc, Design, adc_codes, noise, volts_of_codes
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
