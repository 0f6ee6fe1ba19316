"""P1: which carbon-black fraction gives the finest pressure reading through the readout under verification."""

from __future__ import annotations

from functools import partial

import numpy as np

from ..common import plots
from ..common.arrays import FloatArray
from ..errors import InputError
from ._claim import statement
from ._dut import DesignUnderTest
from ._explore import KNOWN_FRACTION, mixtures, resolution_kpa
from ._outcome import Check, DoesNotApply, Figure, Finding, drawn
from ._quantity import NOMINAL

FRACTIONS = np.array([0.0112, 0.0125, KNOWN_FRACTION, 0.02, 0.025, 0.03, 0.04, 0.05])
CURVE = np.geomspace(FRACTIONS[0], FRACTIONS[-1], 30)


@statement(
    *("P1", "Carbon-black fraction", "II.B, Fig. 3"),
    "Sensitivity (Rmax - R0)/R0 rises as the carbon-black fraction falls; below 1.5 % the resistance is too high "
    "for the acquisition, so 1.5 % is the compromise.",
)
def fraction(dut: DesignUnderTest) -> Finding:
    if not dut.design.board.circuit.virtual_ground or dut.design.adc is None:
        raise DoesNotApply("this study needs a design with amplifiers that hold their lines, and an [adc]")
    law = mixtures(dut)
    fixed, eight = (_resolution(dut, fractions, np.ones(len(fractions))) for fractions in (CURVE, FRACTIONS))
    chosen, free = (_resolution(dut, some, law.rest_resistance(some) / dut.rest) for some in (CURVE, FRACTIONS))
    if np.isinf(eight).all():
        raise InputError("every mixture drives an output into its supply, or no pressure resolution is known")
    best, at_known = float(FRACTIONS[np.argmin(eight)]), float(eight[FRACTIONS == KNOWN_FRACTION][0])
    sensitivity = law.sensitivities(FRACTIONS)
    falls = "sensitivity rises as the fraction falls: smallest ratio of neighbours"
    finest = "1.5 % against the finest of the eight, reference resistor chosen for each: standard deviation"
    return Finding(
        checks=[
            Check(falls, float((sensitivity[:-1] / sensitivity[1:]).min()), 1.0, at_least=True),
            Check(finest, at_known / float(np.min(free)), 1.5, "times"),
            Check("at 1.5 %: standard deviation of one reading, worst load", at_known, 1.0, "% of full scale"),
        ],
        text=[
            "Each mixture is read by the design under verification: its pressure resolution, without load and at full "
            "scale. With the reference resistor of the design, less carbon black leaves less current to measure, and "
            f"more drives the output into its supply (no number there): {100 * best:g} % is the finest of the eight. "
            f"With a resistor in proportion to R0 it is {100 * FRACTIONS[np.argmin(free)]:g} %, by so little that "
            "the acquisition decides, as the paper says. The family goes through the design's cell at 1.5 %; threshold "
            f"{100 * law.threshold:g} % and exponent {law.exponent:g} are the project's own."
        ],
        figures=drawn(partial(_picture, dut, fixed, chosen, eight)),
    )


def _picture(dut: DesignUnderTest, fixed: FloatArray, chosen: FloatArray, eight: FloatArray) -> Figure:
    """The percolation law, and the resolution over :data:`CURVE` with the design's reference resistor or another."""
    law = mixtures(dut)
    with plots.drawing(1, 2) as (figure, (panels,)):
        panels[0].semilogy(100 * CURVE, law.rest_resistance(CURVE) / 1e3)
        panels[0].set(title="Percolation", xlabel="carbon black / % by mass", ylabel="R0 / kΩ")
        other = panels[0].twinx()
        other.plot(100 * CURVE, law.sensitivities(CURVE), color=plots.ORANGE)
        other.plot(100 * FRACTIONS, law.sensitivities(FRACTIONS), "o", color=plots.ORANGE, ms=4)
        other.set_ylabel("sensitivity (Rmax - R0)/R0", color=plots.ORANGE)
        other.grid(visible=False)
        panels[1].semilogy(100 * CURVE, chosen, label="reference resistor chosen for each")
        panels[1].semilogy(100 * CURVE, fixed, label="reference resistor of the design")
        panels[1].semilogy(100 * FRACTIONS, eight, "o", color=plots.ORANGE, ms=4)
        panels[1].set(title="Resolution", xlabel="carbon black / % by mass", ylabel="σ of pressure / % of full scale")
        panels[1].legend()
        said = "Left: percolation law, sensitivity (Fig. 3). Right: what the readout makes of it."
        return Figure(plots.svg(figure), said)


def _resolution(dut: DesignUnderTest, fractions: FloatArray, factors: FloatArray) -> FloatArray:
    """Pressure resolution (fractions,) in % of full scale, the reference resistor times factors; inf beyond limits."""
    pairs = zip(factors.tolist(), fractions.tolist(), strict=True)
    each = ({"reference resistor": factor, "carbon black": fraction} for factor, fraction in pairs)
    return np.array([100 * resolution_kpa(dut, changes, NOMINAL) / dut.full_scale_kpa for changes in each])
