"""Netlists of unequal parts, faults and the voltage-feedback circuit: what ngspice reads, against the solver."""

from __future__ import annotations

import numpy as np
import pytest
from designs import amplifier
from needs import need
from parts_at_random import real_design
from test_netlist import read_by_ngspice

from ohmskin.circuits import CIRCUITS, Design, scan
from ohmskin.circuits.spice import command_available, command_scan, netlist
from ohmskin.errors import SolverError


@pytest.mark.parametrize("circuit", CIRCUITS)
@pytest.mark.parametrize("seed", range(8))
def test_ngspice_reads_unequal_parts_and_faults(circuit: str, seed: int) -> None:
    design, cells = real_design(seed, circuit=circuit, faults=seed % 3)
    np.testing.assert_allclose(read_by_ngspice(design, cells), scan(design, cells).volts, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("circuit", ["inverting-amplifier", "voltage-feedback"])
@pytest.mark.parametrize("seed", range(8))
def test_ngspice_saturates_the_same_outputs(circuit: str, seed: int) -> None:
    design, cells = real_design(seed, circuit=circuit, reference_voltage=0.0, supply=(-0.05, 0.2))
    result = scan(design, cells)
    np.testing.assert_allclose(read_by_ngspice(design, cells), result.volts, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_one_sweep_reads_the_whole_frame(circuit: str) -> None:
    need(command_available())
    for seed in range(5):
        design, cells = real_design(seed, circuit=circuit)
        np.testing.assert_allclose(command_scan(design, cells), scan(design, cells).volts, rtol=1e-6, atol=1e-9)


def test_feedback_without_leads() -> None:
    cells = 10 ** np.random.default_rng(3).uniform(3, 5, (3, 4))
    design = amplifier(3, 4, open_loop_gain=1e5).with_circuit("voltage-feedback")
    np.testing.assert_allclose(read_by_ngspice(design, cells), scan(design, cells).volts, rtol=1e-7)
    cells[1, 1] = 0.0
    with pytest.raises(SolverError, match=r"voltage-feedback circuit cannot express; give array\.column_lead"):
        netlist(design, cells, 1)


def test_the_text_names_the_faults() -> None:
    fault = {"kind": "bridged-columns", "place": [1, 0], "resistance": 12.5}
    design = Design.model_validate(amplifier(2, 2, lead=3.0, segment=1.0).model_dump() | {"fault": [fault]})
    assert "Rfault_0 col_1_0 col_1_1 12.5" in netlist(design, np.full((2, 2), 1e3), 0).splitlines()
