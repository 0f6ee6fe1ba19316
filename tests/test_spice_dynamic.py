"""The netlist in time: ngspice's settling and noise against the project's own, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from needs import need
from worst_boards import random_board_in_time

from ohmskin.circuits import Design, Settling, noise, spice, stability
from ohmskin.errors import InputError
from ohmskin.verification import prototype

CELLS = np.array([[17e3, 10e3, 12e3, 9e3]] * 2 + [[10e3, 17e3, 10e3, 14e3]] * 2)


def _linear(**readout: object) -> Design:
    return prototype().replace(readout={"offset_voltage": 0.0, "bias_current": 0.0, "supply": (-5.0, 5.0)} | readout)


@pytest.mark.parametrize(
    "design",
    [
        _linear(),
        _linear(reference_voltage=1.65, feedback_capacitance=0.0),
        _linear(open_loop_gain=float("inf"), reference_resistance=(15e3, 18e3, 20e3, 22e3)),
    ],
    ids=["prototype", "mid-supply", "unequal"],
)
def test_settling_and_noise_agree(design: Design) -> None:
    need(spice.command_available())
    settling = Settling(design, CELLS)
    period = 0.3 * settling.shortest_period(0.01)
    found = spice.dynamic_reading(design, CELLS, 2, column=1, period=period)
    scale = np.abs(settling.settled[2] - design.readout.reference_voltage).max()
    ours = settling.sampled_from_rest(period)[2]
    assert np.abs(ours - settling.settled[2]).max() > 0.01 * scale  # still on its way
    np.testing.assert_allclose(found.sampled, ours, atol=2e-4 * scale)
    np.testing.assert_allclose(found.settled, settling.settled[2], atol=2e-5 * scale)
    assert found.noise == pytest.approx(noise(design, CELLS).before_adc[2, 1], rel=2e-3)


@pytest.mark.parametrize("cells", [CELLS, CELLS / 3])
@pytest.mark.parametrize("feedback_capacitance", [0.0, 10e-12])
def test_the_loop_gain_agrees(cells: np.ndarray, feedback_capacitance: float) -> None:
    need(spice.command_available())
    no_limit = (-float("inf"), float("inf"))  # an amplifier at a limit does not hold its column
    design = _linear(feedback_capacitance=feedback_capacitance, column_capacitance=300e-12, supply=no_limit)
    found = spice.dynamic_reading(design, cells, 0, column=2)
    expected = stability(design, cells)
    assert found.phase_margin == pytest.approx(expected.phase_margin[0, 2], abs=1e-3)
    assert found.crossover == pytest.approx(expected.crossover[0, 2], rel=2e-5)


def test_an_amplifier_that_never_reaches_gain_1_has_no_margin() -> None:
    need(spice.command_available())
    found = spice.dynamic_reading(_linear(open_loop_gain=2.0), CELLS / 20, 0)
    assert np.isnan([found.phase_margin, found.crossover]).all()


def test_rows_that_are_sensed_have_the_same_dynamics() -> None:
    need(spice.command_available())
    design = _linear(reference_resistance=(15e3, 18e3, 20e3, 22e3)).with_circuit("row-amplifier")
    settling = Settling(design, CELLS)
    period = 0.3 * settling.shortest_period(0.01)
    found = spice.dynamic_reading(design, CELLS, 1, column=3, period=period)  # column 1 is driven, row 3 is judged
    signal = np.abs(settling.settled).max()
    np.testing.assert_allclose(found.sampled, settling.sampled_from_rest(period)[:, 1], atol=2e-4 * signal)
    assert found.noise == pytest.approx(noise(design, CELLS).before_adc[3, 1], rel=2e-3)
    assert found.phase_margin == pytest.approx(stability(design, CELLS).phase_margin[3, 1], abs=0.01)


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 14))])
def test_random_boards_in_time_agree(seed: int) -> None:
    """Early samples, settled readings and phase margins within 2 % of an independent simulator."""
    need(spice.command_available())
    design = random_board_in_time(seed)
    readout: dict[str, object] = {"columns": "parallel", "idle_columns": "float"}
    if not design.board.circuit.has_amplifiers:
        readout |= {"circuit": "inverting-amplifier", "gain_bandwidth": 1e6}
    design = design.replace(readout=readout, adc={"acquisition_time": 0.0})
    cells = 10 ** np.random.default_rng(seed).uniform(3.7, 5.0, design.array.shape)
    settling, turned = Settling(design, cells), design.board.turned
    line = design.board.shape[0] - 1
    period = 0.3 * settling.shortest_period(0.01)
    found = spice.dynamic_reading(design, cells, line, period=period)

    def of_line(values: np.ndarray) -> np.ndarray:
        return values[:, line] if turned else values[line]

    settled = of_line(settling.settled)
    signal = np.abs(settled).max()
    np.testing.assert_allclose(found.settled, settled, atol=0.02 * signal)
    np.testing.assert_allclose(found.sampled, of_line(settling.sampled_from_rest(period)), atol=0.02 * signal)
    margin = float(of_line(stability(design, cells).phase_margin)[0])
    if np.isfinite(margin) or np.isfinite(found.phase_margin):
        assert found.phase_margin == pytest.approx(margin, abs=0.01)


def test_a_swing_limits_the_output() -> None:
    need(spice.command_available())
    design = _linear(supply=(-5.0, 1.5))
    found = spice.dynamic_reading(design, CELLS, 2)
    assert found.settled.max() == pytest.approx(1.5, abs=1e-3)


def test_other_simulators_take_the_commands_for_comments() -> None:
    text = spice.dynamic_netlist(prototype(), CELLS, 0)
    cards = [line for line in text.splitlines()[1:] if not line.startswith("*")]
    assert not any("control" in card for card in cards)
    assert sum(card.split()[0] in (".op", ".tran", ".noise") for card in cards) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"readout": {"gain_bandwidth": float("inf")}}, "nothing takes time"),
        ({"array": {"sheet": "continuous"}}, "sliced sheet"),
        ({"readout": {"circuit": "voltage-divider"}}, "dynamics are modelled for amplifiers"),
    ],
)
def test_what_has_no_dynamics_is_refused(change: dict[str, dict[str, object]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        spice.dynamic_netlist(prototype().replace(**change), CELLS, 0)
