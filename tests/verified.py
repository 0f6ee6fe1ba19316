"""Designs for the tests of the verification."""

from __future__ import annotations

from ohmskin.verification import Report

AMPLIFIED = """
[array]
rows = 3
columns = 3
row_lead = 70.0
[drive]
voltage = -1.0
[readout]
circuit = "inverting-amplifier"
reference_resistance = 20000.0
open_loop_gain = 1e5
gain_bandwidth = 1e6
offset_voltage = 1.7e-3
supply = [0.0, 3.3]
column_capacitance = 100e-12
feedback_capacitance = 10e-12
voltage_noise = 39e-9
temperature = 300.0
"""


def complete(readout: str, adc: str = "bits = 12\nrange = [0.0, 3.3]", operation: str = "frame_rate = 50.0") -> str:
    """DESIGN.toml of a board that names everything that a quantity of the catalogue needs."""
    return f"{readout}\n[adc]\n{adc}\n[operation]\nbaudrate = 1e6\n{operation}\n"


def ids_of(report: Report) -> list[str]:
    """Of its requirements and claims."""
    return [result.requirement.id for result in report.results] + [claim.id for claim in report.claims]


def outcomes_of(report: Report) -> dict[str, str]:
    """By quantity."""
    return {result.requirement.quantity: str(result.outcome) for result in report.results}
