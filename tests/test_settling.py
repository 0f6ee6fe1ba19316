"""Settling against closed forms, an ngspice transient, and an ODE solver; stability against its loop gain."""

from __future__ import annotations

from math import exp, inf, log, pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider
from needs import need
from scipy.integrate import solve_ivp

from ohmskin.circuits import Adc, Design, Settling, Transient, scan, stability
from ohmskin.circuits.spice import command_available, run_command
from ohmskin.errors import InputError, SolverError

CELLS = np.array([[1e4, 2e4, 5e4], [3e4, np.inf, 1.5e4]])


def board(
    adc: dict[str, float] | None = None, *, idle_rows: str = "ground", lead: float = 70.0, **readout: Any
) -> Design:
    rows, columns = CELLS.shape
    design = amplifier(rows, columns, lead=lead, **{"reference_resistance": 2e4, "gain_bandwidth": 1e6} | readout)
    return design.replace(
        drive={"idle_rows": idle_rows},
        adc=None if adc is None else Adc.model_validate({"bits": 12, "range": (0.0, 3.3)} | adc),
    )


def test_one_pole_settles_with_the_noise_gain() -> None:
    """Two rows in turn, GBW only: the deviation at the end of a step is J exp(-T/tau) / (1 + exp(-T/tau))."""
    cells = np.array([[1e4], [5e3]])
    design = amplifier(2, 1, gain_bandwidth=1e6, reference_resistance=2e4)
    gain = 1 + 2e4 * (1 / 1e4 + 1 / 5e3)
    for period in (1e-7, 1e-6, 1e-5):
        left = exp(-period * 2 * pi * 1e6 / gain)
        first, second = 2.0, 4.0
        expected = np.array(
            [[first + (second - first) * left / (1 + left)], [second + (first - second) * left / (1 + left)]]
        )
        np.testing.assert_allclose(Settling(design, cells).sampled(period), expected, rtol=1e-9)


def test_from_rest_an_amplifier_charges_like_one_rc() -> None:
    """All cells alike need no settling in a steady scan; what counts is a row that follows an untouched one."""
    design = amplifier(3, 1, gain_bandwidth=1e6, reference_voltage=1.65, open_loop_gain=inf)
    settling, tau = Settling(design, np.full((3, 1), 2e3)), (1 + 1000.0 * 3 / 2e3) / (2 * pi * 1e6)
    np.testing.assert_allclose(settling.sampled(1e-9), 1.65 + 0.5, rtol=1e-12)
    np.testing.assert_allclose(settling.sampled_from_rest(1e-6), 1.65 + 0.5 * (1 - exp(-1e-6 / tau)), rtol=1e-9)
    assert settling.shortest_period(1e-3) == pytest.approx(tau * log(1e3), rel=1e-6)


def test_one_row_never_changes() -> None:
    design = amplifier(1, 3, gain_bandwidth=1e3)
    cells = np.full((1, 3), 1e3)
    np.testing.assert_allclose(Settling(design, cells).sampled(1e-9), scan(design, cells).volts, rtol=1e-12)


@pytest.mark.parametrize("gain", [1e5, inf])
def test_without_lags_every_sample_is_settled(gain: float) -> None:
    design = board({}, gain_bandwidth=inf, open_loop_gain=gain, column_capacitance=1e-10 if gain == inf else 0.0)
    settling = Settling(design, CELLS)
    np.testing.assert_allclose(settling.sampled(1e-12), scan(design, CELLS, method="exact").volts, rtol=1e-12)
    assert settling.shortest_period(1e-6) == 0


LAGS: dict[str, dict[str, Any]] = {
    "gain-bandwidth": {},
    "finite gain": {"open_loop_gain": 1e2},
    "column capacitance": {"column_capacitance": 5e-11, "open_loop_gain": 1e5},
    "ringing": {"column_capacitance": 2e-9},
    "feedback capacitor": {"column_capacitance": 1e-10, "feedback_capacitance": 1e-11},
    "slow feedback": {"gain_bandwidth": 1e8, "feedback_capacitance": 2e-10},
    "floating rows": {"idle_rows": "float", "column_capacitance": 5e-11},
    "sampler": {"adc": {"sampling_capacitance": 2e-11, "switch_resistance": 1e4}, "column_capacitance": 5e-11},
}


def transient(design: Design, period: float, frames: int) -> np.ndarray:
    """ngspice's samples of the last of some frames: every part of the circuit written out, in time."""
    part, (rows, columns) = design.readout, CELLS.shape
    cards = ["* a scan in time"]
    floating = design.drive.idle_rows == "float"
    for i in range(rows):
        pulse = f"{i * period!r} 1p 1p {period!r} {rows * period!r}"
        cards.append(f"Vdrive{i} d{i} 0 PULSE(0 {design.drive.voltage!r} {pulse})")
        if floating:
            cards.append(f"Vselect{i} s{i} 0 PULSE(0 1 {pulse})")
            cards.append(f"Blead{i} d{i} r{i} I = v(s{i})*(v(d{i})-v(r{i}))/{design.array.row_lead!r}")
        else:
            cards.append(f"Rlead{i} d{i} r{i} {design.array.row_lead!r}")
        cards += [f"R{i}{j} r{i} c{j} {float(CELLS[i, j])!r}" for j in range(columns) if CELLS[i, j] < inf]
    for j in range(columns):
        cards.append(f"Rcol{j} c{j} m{j} {design.array.column_lead!r}")
        cards.append(f"Rref{j} m{j} o{j} {part.reference_resistance!r}")
        cards.append(f"Gamp{j} 0 a{j} 0 m{j} 1")  # 1 S into the capacitor 1/(2 pi GBW)
        cards.append(f"Camp{j} a{j} 0 {1 / (2 * pi * part.gain_bandwidth)!r}")
        cards += [f"Ramp{j} a{j} 0 {part.open_loop_gain!r}"] if part.open_loop_gain < inf else []
        cards.append(f"Eamp{j} o{j} 0 a{j} 0 1")
        cards += [f"Ccol{j} m{j} 0 {part.column_capacitance!r}"] if part.column_capacitance else []
        cards += [f"Cref{j} m{j} o{j} {part.feedback_capacitance!r}"] if part.feedback_capacitance else []
        if design.adc:
            cards += [
                f"Rsw{j} o{j} q{j} {design.adc.switch_resistance!r}",
                f"Cs{j} q{j} 0 {design.adc.sampling_capacitance!r}",
            ]
    stop = frames * rows * period
    cards.append(".options reltol=1e-6 abstol=1e-14 vntol=1e-9 chgtol=1e-18 trtol=1")
    cards += [f".tran {period / 100!r} {stop!r} 0 {period / 2000!r}", ".end"]
    vectors = run_command("\n".join(cards))
    instants = (np.arange((frames - 1) * rows, frames * rows) + 1) * period
    node = "q" if design.adc else "o"
    return np.column_stack([np.interp(instants, vectors["time"], vectors[f"{node}{j}"]) for j in range(columns)])


@pytest.mark.parametrize("name", LAGS)
def test_against_an_ngspice_transient(name: str) -> None:
    need(command_available())
    design = board(**LAGS[name])
    settling = Settling(design, CELLS)
    period = settling.shortest_period(0.1)
    sampled = settling.sampled(period)
    scale = np.abs(settling.settled).max()
    assert np.abs(sampled - settling.settled).max() > 0.02 * scale  # there is something to compare
    np.testing.assert_allclose(transient(design, period, 4), sampled, atol=2e-5 * scale)


SHARED = {"sampling_capacitance": 5e-9, "switch_resistance": 2e3, "acquisition_time": 10e-6}
DIVIDERS: dict[str, dict[str, Any]] = {
    "loads": {},
    "loads, a capacitor each": {"adc": {"sampling_capacitance": 5e-9, "switch_resistance": 2e3}},
    "loads, ideal switches": {"adc": {"sampling_capacitance": 5e-9}},
    "loads, one capacitor": {"adc": SHARED},
    "open": {"idle_columns": "float"},
    "open, floating rows": {"idle_columns": "float", "idle_rows": "float"},
    "loads, floating rows": {"idle_rows": "float"},
    "open, one capacitor": {"idle_columns": "float", "adc": SHARED},
}
"""Circuits whose samples are far from settled after 150 us per row."""


def divider_transient(design: Design, cells: np.ndarray, period: float, frames: int) -> np.ndarray:
    """As :func:`transient`, of a divider: its switches are currents that pulses turn on and off."""
    (rows, columns), part, adc = cells.shape, design.readout, design.adc
    frame, one_by_one = rows * period, part.idle_columns == "float"
    acquisition = adc.acquisition_time if adc else 0.0
    slot = period / columns if one_by_one else acquisition

    def pulse(name: str, start: float, width: float, every: float) -> str:
        return f"V{name} {name} 0 PULSE(0 1 {start!r} 1n 1n {width - 1e-9!r} {every!r})"

    cards = ["* a divider in time"]
    for i in range(rows):
        cards.append(pulse(f"row{i}", i * period, period, frame))
        level = f"v(row{i})*{design.drive.voltage!r}"
        on = f"v(row{i})*" if design.drive.idle_rows == "float" else ""
        cards.append(f"Blead{i} 0 r{i} I = {on}({level}-v(r{i}))/{design.array.row_lead!r}")
        cards += [f"R{i}{j} r{i} c{j} {float(cells[i, j])!r}" for j in range(columns)]
    for j in range(columns):
        cards += [f"Rlead{j} c{j} e{j} {design.array.column_lead!r}", f"C{j} e{j} 0 {part.column_capacitance!r}"]
        start = period - (columns - j) * slot
        if one_by_one:
            cards.append(pulse(f"on{j}", start, slot, period))
            cards.append(f"Bload{j} e{j} 0 I = v(on{j})*v(e{j})/{part.reference_resistance!r}")
        else:
            cards.append(f"Rload{j} e{j} 0 {part.reference_resistance!r}")
        if adc and not acquisition:
            cards.append(f"Rs{j} e{j} q{j} {adc.switch_resistance or 1e-2!r}")
            cards.append(f"Cs{j} q{j} 0 {adc.sampling_capacitance!r}")
        elif adc:
            end = start + slot
            cards.append(pulse(f"take{j}", end - acquisition, acquisition, period))
            cards.append(f"Bsw{j} e{j} q I = v(take{j})*(v(e{j})-v(q))/{adc.switch_resistance!r}")
    if adc and acquisition:
        cards.append(f"Cs q 0 {adc.sampling_capacitance!r}")
    cards.append(".options reltol=1e-6 abstol=1e-14 vntol=1e-9 chgtol=1e-18 trtol=1")
    cards += [f".tran {period / 100!r} {frames * frame!r} 0 {period / 1000!r}", ".end"]
    vectors = run_command("\n".join(cards))
    ends = np.arange((frames - 1) * rows, frames * rows)[:, None] * period + period
    ends = ends - (columns - 1 - np.arange(columns)) * slot
    nodes = ["q" if acquisition else f"q{j}" if adc else f"e{j}" for j in range(columns)]
    return np.column_stack([np.interp(ends[:, j], vectors["time"], vectors[node]) for j, node in enumerate(nodes)])


@pytest.mark.parametrize("name", DIVIDERS)
def test_a_divider_against_an_ngspice_transient(name: str) -> None:
    need(command_available())
    cells = np.array([[7e3, 1e6, 2e4], [3e4, 5e4, 1e6], [1e6, 9e3, 1e5]])
    keys = dict(DIVIDERS[name])
    adc, idle = keys.pop("adc", None), keys.pop("idle_rows", "ground")
    design = divider(3, 3, row_lead=100.0, column_lead=100.0).replace(
        drive={"voltage": 5.0, "idle_rows": idle},
        readout={"reference_resistance": 1e4, "column_capacitance": 1e-8, "idle_columns": "load"} | keys,
        adc=None if adc is None else Adc.model_validate({"bits": 12, "range": (0.0, 5.0)} | adc),
    )
    settling = Settling(design, cells)
    sampled = settling.sampled(150e-6)
    assert np.abs(sampled - settling.settled).max() > 0.02 * settling.signal
    np.testing.assert_allclose(divider_transient(design, cells, 150e-6, 5), sampled, atol=2e-4 * settling.signal)


@pytest.mark.parametrize("idle_columns", ["load", "float"])
def test_a_divider_of_one_column_charges_like_one_rc(idle_columns: str) -> None:
    """tau = C (load, cells and lead in parallel); a sampler of 0 ohm adds its capacitance to that of the column."""
    adc = Adc(bits=10, range=(0.0, 5.0), sampling_capacitance=2e-9)
    readout = {"reference_resistance": 1e4, "column_capacitance": 8e-9, "idle_columns": idle_columns}
    design = divider(2, 1, idle_rows="ground").replace(readout=readout, adc=adc)
    settling = Settling(design, np.array([[7e3], [1e6]]))
    tau = 1e-8 / (1 / 1e4 + 1 / 7e3 + 1 / 1e6)
    np.testing.assert_allclose(settling.sampled_from_rest(1e-4), settling.settled * (1 - exp(-1e-4 / tau)), rtol=1e-9)
    assert settling.shortest_period(1e-3) == pytest.approx(tau * log(1e3), rel=1e-6)


@pytest.mark.parametrize("capacitance", [0.0, 1e-11], ids=["an ideal sampler", "a capacitor"])
def test_one_sampling_capacitor_serves_the_columns_in_turn(capacitance: float) -> None:
    """Against an ODE solver that runs amplifiers and capacitor through many frames, each column in its own slot."""
    slot, period = 2e-7, 2e-6
    design = board({"sampling_capacitance": capacitance, "switch_resistance": 1e4, "acquisition_time": slot})
    settling, tau = Settling(design, CELLS), 1e4 * capacitance
    rows, columns = CELLS.shape
    # v' = -w (u + v/A), with Y u + (u - v)/Rref = 0: the crosspoints of rows behind leads eliminated (Schur), 1/A = 0.
    leads = np.eye(columns) / 70.0
    cells = np.nan_to_num(1.0 / CELLS)
    inner = leads + np.diag(cells.sum(axis=0)) - cells.T @ np.diag(1.0 / (1.0 / 70.0 + cells.sum(axis=1))) @ cells
    seen = leads - leads @ np.linalg.solve(inner, leads)
    matrix = -2 * pi * 1e6 / 2e4 * np.linalg.inv(seen + np.eye(columns) / 2e4)
    state, samples = np.r_[settling.settled[-1], 0.0], np.zeros(CELLS.shape)
    for step in range(6 * rows):
        goal = settling.settled[step % rows]

        def rate(_: float, state: np.ndarray, chosen: int | None, goal: np.ndarray = goal) -> np.ndarray:
            charging = 0.0 if chosen is None or not tau else (state[chosen] - state[-1]) / tau
            return np.r_[matrix @ (state[:-1] - goal), charging]

        for chosen, duration in [(None, period - columns * slot), *((j, slot) for j in range(columns))]:
            run = solve_ivp(rate, (0, duration), state, args=(chosen,), rtol=1e-10, atol=1e-12)
            state = run.y[:, -1]
            if chosen is not None:
                samples[step % rows, chosen] = state[-1] if tau else state[chosen]
    assert np.abs(samples - settling.settled).max() > 0.01
    np.testing.assert_allclose(settling.sampled(period), samples, atol=1e-7)


def test_the_first_column_has_the_least_time_to_settle() -> None:
    """8 columns of 2 us each at 1 MHz: 16 us serve the last column alone."""
    cells = np.full((2, 8), 5e3)
    cells[1] = 5e4
    adc = Adc(bits=12, range=(0.0, 3.3), acquisition_time=2e-6)
    design = amplifier(2, 8, gain_bandwidth=1e6, reference_resistance=2e4).replace(adc=adc)
    settling = Settling(design, cells)
    tau = (1 + 2e4 * (1 / 5e3 + 1 / 5e4)) / (2 * pi * 1e6)
    off = np.abs(settling.sampled_from_rest(16e-6) / settling.settled - 1.0)
    np.testing.assert_allclose(off, np.tile(np.exp(-2e-6 * np.arange(1, 9) / tau), (2, 1)), rtol=1e-6, atol=1e-12)
    assert settling.shortest_period(1e-3) == pytest.approx(14e-6 + tau * log(1e3), rel=1e-6)


def test_rows_that_are_sensed_are_converted_in_the_order_of_their_numbers() -> None:
    """The array with amplifiers on its rows is the turned one with amplifiers on its columns, but for the order."""
    parts = {"gain_bandwidth": 1e6, "reference_resistance": 2e4, "lead": 70.0}
    adc = Adc(bits=12, range=(0.0, 3.3), sampling_capacitance=1e-11, switch_resistance=1e4, acquisition_time=2e-7)
    on_rows = amplifier(*CELLS.shape, circuit="row-amplifier", **parts).replace(adc=adc)
    on_columns = amplifier(*CELLS.shape[::-1], **parts).replace(adc=adc)  # without segments lines have no direction
    one, other = Settling(on_rows, CELLS), Settling(on_columns, CELLS.T)
    np.testing.assert_allclose(one.sampled(1e-6), other.sampled(1e-6).T, rtol=1e-9)
    np.testing.assert_allclose(one.sampled_from_rest(1e-6), other.sampled_from_rest(1e-6).T, rtol=1e-9)
    assert one.shortest_period(0.2) == pytest.approx(other.shortest_period(0.2), rel=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_a_ringing_amplifier_keeps_its_error_at_every_longer_period(seed: int) -> None:
    """Phase margins below 20 degrees: an error that falls below the limit and rises above it again does not count."""
    rng = np.random.default_rng(seed)
    cells = 10 ** rng.uniform(3.5, 5.5, (2, 2))
    margin = 90.0
    while not 2.0 < margin < 20.0:
        design = amplifier(
            2,
            2,
            lead=float(rng.choice([0.0, 70.0])),
            reference_resistance=2e4,
            gain_bandwidth=float(10 ** rng.uniform(5, 8)),
            column_capacitance=float(10 ** rng.uniform(-10, -7)),
        )
        stable = stability(design, cells)
        margin = float(stable.phase_margin.min())
    settling, error = Settling(design, cells), float(10 ** rng.uniform(-4, -0.5))
    period = settling.shortest_period(error)
    ringing = 2 * pi * stable.crossover.max()
    longer = period + np.linspace(0.0, min(2.0 * period, 60.0 / ringing), 400)
    assert max(map(settling.error, longer)) <= error * (1 + 1e-9)
    assert settling.error(0.9999 * period) > error


@pytest.mark.parametrize("name", LAGS)
@pytest.mark.parametrize("error", [0.05, 1e-3, 1e-6])
def test_the_shortest_period_keeps_its_error_and_no_shorter_one_does(name: str, error: float) -> None:
    settling = Settling(board(**LAGS[name]), CELLS)
    period = settling.shortest_period(error)
    assert all(settling.error(longer) <= error for longer in period * np.geomspace(1, 10, 100))
    assert settling.error(0.999 * period) > error


def test_a_capacitor_that_cannot_follow_is_named() -> None:
    design = board({"sampling_capacitance": 1e-11, "switch_resistance": 1e4, "acquisition_time": 2e-7})
    assert Settling(design, CELLS).shortest_period(0.2) > 2e-7
    with pytest.raises(SolverError, match="acquisition_time"):
        Settling(design, CELLS).shortest_period(1e-3)


@pytest.mark.parametrize("name", [n for n in LAGS if n not in {"sampler", "floating rows"}])
def test_stability_is_that_of_the_loop_gain(name: str) -> None:
    """Crossover, margin and peak from the transfer functions themselves, on a fine grid of frequencies."""
    design = board(**LAGS[name], lead=0.0)  # ideal lines: Y_jj is the sum of the column's cells
    part, result = design.readout, stability(design, CELLS)
    frequency = np.geomspace(1e1, 1e9, 200_001)
    s = 2j * pi * frequency
    amplifier_gain = 1 / (s / (2 * pi * part.gain_bandwidth) + 1 / part.open_loop_gain)
    for j in range(CELLS.shape[1]):
        load = (1 / CELLS[:, j]).sum()
        feedback = 1 / part.reference_resistance + s * part.feedback_capacitance
        loop = amplifier_gain * feedback / (feedback + load + s * part.column_capacitance)
        transfer = loop / (1 + loop) / feedback
        at = np.argmin(np.abs(np.log(np.abs(loop))))
        assert result.noise_gain[0, j] == pytest.approx(1 + part.reference_resistance * load)
        assert result.crossover[0, j] == pytest.approx(frequency[at], rel=1e-3)
        assert result.phase_margin[0, j] == pytest.approx(180 + np.degrees(np.angle(loop[at])), abs=0.1)
        assert result.peaking[0, j] == pytest.approx((np.abs(transfer) / np.abs(transfer[0])).max(), rel=1e-3)


def test_a_feedback_capacitor_calms_the_amplifier() -> None:
    restless = stability(board(column_capacitance=2e-9), CELLS)
    calm = stability(board(column_capacitance=2e-9, feedback_capacitance=5e-11), CELLS)
    assert (restless.peaking > 1.5).all()
    assert (calm.phase_margin > restless.phase_margin + 20).all()


def test_what_is_not_modelled_is_refused() -> None:
    with pytest.raises(InputError, match="inverting-amplifier"):
        Settling(divider(2, 3).with_circuit("voltage-feedback"), CELLS)
    with pytest.raises(SolverError, match="saturates"):
        Settling(board(supply=(0.0, 0.5)), CELLS)
    with pytest.raises(InputError, match="gain_bandwidth"):
        stability(board(gain_bandwidth=inf), CELLS)
    with pytest.raises(InputError, match="row period 0"):
        Settling(board(), CELLS).sampled(0.0)
    with pytest.raises(InputError, match="settling error"):
        Settling(board(), CELLS).shortest_period(0.0)


def test_unequal_columns_are_each_their_own() -> None:
    """Without line resistance columns do not meet: a design with a list per column is its columns, one by one."""
    cells = np.array([[1e4, 5e3, 2e4], [8e3, 1e4, 3e4]])
    references, gains, leads = (2e4, 1e4, 3e4), (1e5, 2e4, 1e6), (0.0, 50.0, 10.0)

    def alike(columns: int, **parts: Any) -> Design:
        return Design.model_validate(
            {
                "array": {"rows": 2, "columns": columns, "column_lead": parts.pop("lead")},
                "drive": {"voltage": -1.0},
                "readout": {
                    "circuit": "inverting-amplifier",
                    "gain_bandwidth": 1e6,
                    "column_capacitance": 1e-10,
                    "feedback_capacitance": 5e-12,
                }
                | parts,
            }
        )

    together = alike(3, reference_resistance=references, open_loop_gain=gains, lead=leads)
    sampled = Settling(together, cells).sampled(4e-6)
    margins = stability(together, cells)
    for column, (reference, gain, lead) in enumerate(zip(references, gains, leads, strict=True)):
        alone = alike(1, reference_resistance=reference, open_loop_gain=gain, lead=lead)
        own = cells[:, [column]]
        np.testing.assert_allclose(Settling(alone, own).sampled(4e-6)[:, 0], sampled[:, column], rtol=1e-9)
        np.testing.assert_allclose(stability(alone, own).phase_margin[:, 0], margins.phase_margin[:, column])
        np.testing.assert_allclose(stability(alone, own).peaking[:, 0], margins.peaking[:, column])


def test_one_sampling_capacitor_needs_its_time_for_every_column() -> None:
    serving = {"sampling_capacitance": 1e-12, "switch_resistance": 1e3, "acquisition_time": 2e-6}
    settling = Settling(board(serving), CELLS)
    assert settling.shortest_period(0.1) >= 2e-6 * CELLS.shape[1]
    with pytest.raises(InputError, match="for each column"):
        settling.sampled(4e-6)


# Transient response event by event, against the settling of a scan


BOARD = Design.load(Path(__file__).parents[1] / "examples" / "board-4x4.toml")
# Rows without cells between the others: each loaded row then follows one without signal, as sampled_from_rest has it.
SWITCHED_CELLS = np.array([[12e3, 9e3, 17e3, 11e3], [np.inf] * 4, [8e3, 10e3, 30e3, 1e6], [np.inf] * 4])
VARIANTS = {
    "as built": BOARD,
    "without capacitances": BOARD.replace(readout={"column_capacitance": 0.0, "feedback_capacitance": 0.0}),
    "slow capacitor": BOARD.replace(adc={"sampling_capacitance": 2e-10}),
    "no capacitor": BOARD.replace(adc={"sampling_capacitance": 0.0, "acquisition_time": 0.0}),
    "floating idle rows": BOARD.replace(drive={"idle_rows": "float"}),
}


@pytest.mark.parametrize("design", VARIANTS.values(), ids=VARIANTS.keys())
@pytest.mark.parametrize("period", [50e-6, 90e-6])
def test_a_row_selected_from_rest_reads_as_settling_predicts(design: Design, period: float) -> None:
    predicted = Settling(design, SWITCHED_CELLS).sampled_from_rest(period)
    settled = scan(design, SWITCHED_CELLS).volts
    assert design.adc is not None
    acquisition = design.adc.acquisition_time
    for row in (0, 2):
        for column in range(4):
            transient = Transient(design, SWITCHED_CELLS)
            transient.aim(settled[row], row)
            transient.advance(period - (4 - column) * acquisition)  # the last conversion ends with the step
            transient.connect(column)
            transient.advance(acquisition)
            assert transient.disconnect() == pytest.approx(predicted[row, column], abs=1e-10)
    assert np.abs(predicted - settled)[[0, 2]].max() > 1e-4 or not design.readout.feedback_capacitance


def test_time_may_pass_in_any_pieces() -> None:
    settled = scan(BOARD, SWITCHED_CELLS).volts
    whole, pieces = Transient(BOARD, SWITCHED_CELLS), Transient(BOARD, SWITCHED_CELLS)
    for one in (whole, pieces):
        one.aim(settled[2])
        one.connect(1)
    whole.advance(23e-6)
    for share in (1e-6, 7e-6, 15e-6):
        pieces.advance(share)
    np.testing.assert_allclose(pieces.outputs(), whole.outputs(), rtol=1e-12)
    assert pieces.disconnect() == pytest.approx(whole.disconnect(), rel=1e-12)


def test_outputs_go_on_without_a_jump_when_row_or_cells_change() -> None:
    settled = scan(BOARD, SWITCHED_CELLS).volts
    transient = Transient(BOARD, SWITCHED_CELLS)
    transient.aim(settled[0])
    transient.advance(10e-6)
    before = transient.outputs()
    transient.aim(settled[2])
    np.testing.assert_allclose(transient.outputs(), before, rtol=1e-12)
    other = np.where(np.isinf(SWITCHED_CELLS), 20e3, SWITCHED_CELLS)
    transient.change(BOARD, other)
    transient.aim(scan(BOARD, other).volts[2])
    np.testing.assert_allclose(transient.outputs(), before, rtol=1e-12)
    transient.advance(1e-2)
    np.testing.assert_allclose(transient.outputs(), scan(BOARD, other).volts[2], rtol=1e-12)


def test_a_capacitor_as_slow_as_an_output_is_no_division_by_zero() -> None:
    """The limit of the difference quotient of two equal time constants."""
    design = BOARD.replace(
        readout={"gain_bandwidth": np.inf, "open_loop_gain": np.inf, "column_capacitance": 0.0},
        adc={"switch_resistance": 15e3, "sampling_capacitance": 1e-9},
    )
    near = design.replace(adc={"sampling_capacitance": 1.001e-9})
    values = []
    for one in (design, near):
        transient = Transient(one, SWITCHED_CELLS)
        transient.aim(scan(one, SWITCHED_CELLS).volts[0])
        transient.connect(0)
        transient.advance(20e-6)
        values.append(transient.disconnect())
    assert values[0] == pytest.approx(values[1], rel=1e-3)
    assert values[0] != values[1]


def test_circuits_without_amplifiers_are_refused() -> None:
    with pytest.raises(InputError, match="settling and noise"):
        Transient(BOARD.replace(readout={"circuit": "voltage-divider"}), SWITCHED_CELLS)
