"""P1: which carbon-black fraction gives the finest pressure reading through the readout under verification."""

from __future__ import annotations

import numpy as np

from ..cell import Percolation
from ..circuits import Design, adc_codes, clipped, noise, scan
from ..common import plots
from ..common.arrays import FloatArray
from ..errors import InputError
from ._dut import DesignUnderTest
from ._outcome import Check, Figure, Finding, does_not_apply, drawn

KNOWN = 0.015  # the fraction that the paper chose, and that the shipped example cell stands for
FRACTIONS = np.array([0.0112, 0.0125, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05])
CURVE = np.geomspace(FRACTIONS[0], FRACTIONS[-1], 30)
LOADS = np.linspace(0.0, 1.0, 6)


def fraction(dut: DesignUnderTest) -> Finding:
    """Sensitivity and resolution against the carbon-black fraction."""
    if not dut.design.board.circuit.virtual_ground or dut.design.adc is None:
        return does_not_apply("this study needs a design with amplifiers that hold their lines, and an [adc]")
    law = Percolation(KNOWN, dut.rest, dut.pressed / dut.rest - 1)
    fixed, chosen = (np.array([_resolution(dut, law, f, choose=choose) for f in CURVE]) for choose in (False, True))
    eight, free = (np.array([_resolution(dut, law, f, choose=choose) for f in FRACTIONS]) for choose in (False, True))
    if np.isnan(eight).all():
        raise InputError("every mixture drives an output of this design into its supply at some load")
    best = float(FRACTIONS[np.nanargmin(eight)])
    sensitivity = law.sensitivities(FRACTIONS)
    return Finding(
        checks=[
            Check(
                "sensitivity rises as the fraction falls: smallest ratio of neighbours",
                float((sensitivity[:-1] / sensitivity[1:]).min()),
                1.0,
                at_least=True,
            ),
            Check(
                "1.5 % against the finest of the eight, reference resistor chosen for each: standard deviation",
                float(eight[FRACTIONS == KNOWN][0] / np.nanmin(free)),
                1.5,
                "times",
            ),
            Check(
                "at 1.5 %: standard deviation of one reading, worst load",
                float(eight[FRACTIONS == KNOWN][0]),
                1.0,
                "% of full scale",
            ),
        ],
        text=[
            "Each mixture is read by the design under verification, at every load from none to full scale: the noise "
            "of amplifiers and resistors and the ADC's steps, divided by the slope of the output against pressure. "
            "With the reference resistor of the design, less carbon black leaves less current to measure, and more "
            f"drives the output into its supply (no number there): {100 * best:g} % is the finest of the eight. With a "
            f"resistor chosen for each mixture it is {100 * FRACTIONS[np.nanargmin(free)]:g} %, by so little that the "
            "acquisition decides, as the paper says. The "
            f"family goes through the example cell at 1.5 %; threshold {100 * law.threshold:g} % and exponent "
            f"{law.exponent:g} are the project's own."
        ],
        figures=drawn(
            lambda: Figure(
                _picture(law, fixed, chosen, eight),
                "Left: percolation law, sensitivity (Fig. 3). Right: what the readout makes of it.",
            )
        ),
    )


def _picture(law: Percolation, fixed: FloatArray, chosen: FloatArray, eight: FloatArray) -> str:
    """The percolation law, and the resolution over :data:`CURVE` with the design's reference resistor or another."""
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
        return plots.svg(figure)


def _resolution(dut: DesignUnderTest, law: Percolation, f: float, *, choose: bool) -> float:
    """Standard deviation of one reading in % of full scale pressure, at the worst load; NaN where a reading saturates.

    With ``choose`` the reference resistor is scaled with R0, which keeps the output at rest where it is.
    """
    ohms = law.resistance(f, LOADS)
    design = dut.design
    if choose:
        reference = np.asarray(design.readout.reference_resistance) * (ohms[0] / dut.rest)
        value = tuple(reference.tolist()) if reference.ndim else float(reference)
        design = design.replace(readout={"reference_resistance": value})
    slope = np.gradient(ohms, LOADS)
    scatter = [_scatter(design, r, d) if np.isfinite(r) else np.nan for r, d in zip(ohms, slope, strict=True)]
    return float(np.max(scatter))  # NaN if any is


def _scatter(design: Design, ohms: float, ohms_per_scale: float) -> float:
    """Standard deviation in % of full scale of a skin whose cells are all at ``ohms``; NaN if it saturates."""
    cells = np.full(design.array.shape, ohms)
    result = scan(design, cells, method="exact")
    if result.saturated.any() or clipped(design, adc_codes(design, result.volts)).any():
        return float("nan")
    volts = noise(design, cells).volts
    reference = np.asarray(design.readout.reference_resistance)
    volts_per_scale = abs(design.drive.voltage) * reference / ohms**2 * ohms_per_scale
    return float(100 * (volts / volts_per_scale).max())
