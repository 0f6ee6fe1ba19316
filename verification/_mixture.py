"""P1: which carbon-black fraction gives the finest pressure reading through the readout under verification."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..common import plots
from ..common.arrays import FloatArray
from ..errors import InputError
from ._claim import statement
from ._dut import DesignUnderTest
from ._explore import KNOWN_FRACTION, mixtures, resolution_kpa
from ._outcome import Check, DoesNotApply, Finding
from ._pictures import picture
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
    caption = "Left: percolation law, sensitivity (Fig. 3). Right: what the readout makes of it."

    def draw(panels: Any) -> None:
        left, right = panels[0]
        left.semilogy(100 * CURVE, law.rest_resistance(CURVE) / 1e3)
        left.set(title="Percolation", xlabel="carbon black / % by mass", ylabel="R0 / kΩ")
        other = left.twinx()
        other.plot(100 * CURVE, law.sensitivities(CURVE), color=plots.ORANGE)
        other.plot(100 * FRACTIONS, sensitivity, "o", color=plots.ORANGE, ms=4)
        other.set_ylabel("sensitivity (Rmax - R0)/R0", color=plots.ORANGE)
        other.grid(visible=False)
        right.semilogy(100 * CURVE, chosen, label="reference resistor chosen for each")
        right.semilogy(100 * CURVE, fixed, label="reference resistor of the design")
        right.semilogy(100 * FRACTIONS, eight, "o", color=plots.ORANGE, ms=4)
        right.set(title="Resolution", xlabel="carbon black / % by mass", ylabel="σ of pressure / % of full scale")
        right.legend()

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
        figures=picture(caption, draw, 1, 2, height=2.9),
    )


def _resolution(dut: DesignUnderTest, fractions: FloatArray, factors: FloatArray) -> FloatArray:
    """Pressure resolution (fractions,) in % of full scale, the reference resistor times factors; inf beyond limits."""
    pairs = zip(factors.tolist(), fractions.tolist(), strict=True)
    each = ({"reference resistor": factor, "carbon black": fraction} for factor, fraction in pairs)
    return np.array([100 * resolution_kpa(dut, changes, NOMINAL) / dut.full_scale_kpa for changes in each])
