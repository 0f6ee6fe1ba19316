"""The paper's claims P1 to P14, and the experiment that answers each."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from . import _crosstalk as crosstalk
from . import _material as material
from . import _mixture as mixture
from . import _whole_skin as skin
from ._dut import DesignUnderTest
from ._outcome import Finding

Experiment = Callable[[DesignUnderTest], Finding]


class Statement(NamedTuple):
    """A claim before its experiment was run."""

    id: str
    title: str
    where: str
    says: str
    experiment: Experiment


STATEMENTS = (
    Statement(
        "P1",
        "Carbon-black fraction",
        "II.B, Fig. 3",
        "Sensitivity (Rmax - R0)/R0 rises as the carbon-black fraction falls; below 1.5 % the resistance is too high "
        "for the acquisition, so 1.5 % is the compromise.",
        mixture.fraction,
    ),
    Statement(
        "P2",
        "Bonded and touching electrodes",
        "III, Figs. 4, 5",
        "With electrodes cast in, resistance rises with pressure and shows the material's viscoelastic shape; with "
        "electrodes that merely touch, contact resistance dominates and falls.",
        material.electrodes,
    ),
    Statement(
        "P3",
        "Resistance follows strain",
        "(1), (2)",
        "The change of resistance is proportional to strain, so resistance is a function of stress.",
        material.strain,
    ),
    Statement(
        "P4",
        "Rising phase",
        "(3), Fig. 6",
        "Under load: a jump, an overshoot, then slow settling, as a gain plus a first-order term in the stress rate.",
        material.rising,
    ),
    Statement(
        "P5",
        "Recovery phase",
        "(4)-(8), Figs. 7, 8",
        "After unloading: an augmented Burgers model of five elements, which always returns to R0.",
        material.recovery,
    ),
    Statement(
        "P6",
        "Coefficients from the recovery curve",
        "(9)",
        "E_i is the inverse gain of each branch of the recovery curve, eta_i = T_i E_i.",
        material.identification,
    ),
    Statement(
        "P7",
        "Recovery times",
        "IV",
        "Up to 25 s to 95 % recovery, up to 5 minutes to full recovery.",
        material.recovery_times,
    ),
    Statement(
        "P8",
        "Pressure by inverse filters",
        "V, Fig. 9",
        "Pressure is the inverse filter of resistance, switched between two models by thresholds on its derivative.",
        material.inverse_filter,
    ),
    Statement(
        "P9",
        "One step and three steps",
        "V.A, Figs. 10, 11",
        "The estimate follows the applied stress for a 15.5 kPa step, and for three in a row with creep.",
        material.steps,
    ),
    Statement(
        "P10",
        "Slicing isolates the cells",
        "VI, Fig. 12",
        "Slicing the sheet isolates the cells; unsliced it still works, but the cells couple.",
        crosstalk.slicing,
    ),
    Statement(
        "P11",
        "A divider reads the whole grid",
        "VII, Fig. 13",
        "With a plain voltage divider the resistance found is the equivalent resistance of the grid.",
        crosstalk.grid_resistance,
    ),
    Statement(
        "P12",
        "The inverting amplifier",
        "(10), Fig. 14",
        "With the column held at ground by an inverting amplifier, Vout = -Vin Rref / Rij.",
        crosstalk.equation_10,
    ),
    Statement(
        "P13",
        "No crosstalk",
        "VII, Fig. 15",
        "An amplifier on each column and all idle rows grounded: each cell is read without any crosstalk.",
        crosstalk.crosstalk,
    ),
    Statement(
        "P14",
        "A whole skin in real time",
        "I, VIII",
        "Several contacts at once, their places and their pressures, in real time.",
        skin.whole_skin,
    ),
)
