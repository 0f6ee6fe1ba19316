"""How fast and how quietly the design can be scanned; part of P14."""

from __future__ import annotations

import numpy as np

from ..circuits import Settling, noise, scan, stability
from ..common import plots
from ..errors import InputError, SolverError
from ._outcome import Check, Figure, Finding, Table
from ._subject import Subject


def timing(subject: Subject, frame_rate_hz: float) -> Finding:
    """Fastest scan that settles to a quarter of an ADC step, stability, and noise of each reading.

    A divider, or a design whose dynamics or noise are not named, has no such numbers: its finding is without checks.
    """
    design, adc = subject.design, subject.design.adc
    if not design.board.circuit.virtual_ground or adc is None:
        return Finding(checks=[])
    # The worst frame for settling: every other row pressed, so that each row switch is a jump for every column.
    cells = np.full(design.array.shape, subject.rest)
    cells[::2] = subject.pressed
    checks, figures, rows = [], [], []
    try:
        settling = Settling(design, cells)
    except SolverError as error:
        return Finding(checks=[Check("fastest scan", None, frame_rate_hz, reason=str(error))])
    signal = float(np.abs(settling.settled - design.readout.reference_voltage).max())
    quarter = adc.step / 4 / signal
    period = settling.shortest_period(quarter)
    if period > 0:
        rate = 1 / (period * design.board.shape[0])
        checks.append(Check("fastest scan settled to 1/4 ADC step", rate, frame_rate_hz, "frames/s", at_least=True))
        rows.append(["row period to settle to 1/4 ADC step", f"{1e6 * period:.3g} µs"])
        shortest = max(0.2 * period, adc.acquisition_time * design.board.shape[1])
        periods = np.geomspace(shortest, 3.0 * period, 40)
        with plots.drawing(1, 1, height=2.6) as (figure, axes):
            axes[0, 0].semilogy(1e6 * periods, [settling.error(p) for p in periods])
            axes[0, 0].axhline(quarter, color=plots.RED, lw=1, ls="--")
            axes[0, 0].set(title="Settling", xlabel="row period / µs", ylabel="error / largest signal")
            figures.append(Figure(plots.svg(figure), "Error at the sample instant; dashed: a quarter of an ADC step."))
    if design.board.virtual_grounds and np.isfinite(design.readout.gain_bandwidth):
        stable = stability(design, cells)
        checks.append(Check("phase margin", float(np.nanmin(stable.phase_margin)), 45.0, "°", at_least=True))
        rows += [
            ["noise gain", f"{stable.noise_gain.max():.3g}"],
            ["closed-loop bandwidth", f"{1e-3 * np.nanmin(stable.crossover):.3g} kHz"],
            ["peaking", f"{stable.peaking.max():.3g}"],
        ]
    try:
        scatter = noise(design, cells)
    except InputError as error:
        rows.append(["noise", f"no number: {error}"])
    else:
        loudest = {name: float(part.max()) for name, part in scatter.parts.items() if part.max() > 0}
        rows += [[f"noise: {name}", f"{1e6 * volts:.3g} µV rms"] for name, volts in loudest.items()]
        reading = scan(design, cells)
        ohms = cells**2 * scatter.volts / (abs(design.drive.voltage) * np.asarray(design.readout.reference_resistance))
        share = ohms / (subject.pressed - subject.rest) * 100
        rows.append(["noise of a reading, all together", f"{1e6 * scatter.volts.max():.3g} µV rms"])
        rows.append(["... in pressure, worst cell", f"{share[~reading.saturated].max():.2g} % of full scale"])
    return Finding(
        checks=checks,
        text=["Dynamics and noise with every other row pressed, so that each row switch is a jump for every column."],
        figures=figures,
        tables=[Table(["quantity", "value"], rows, "Speed, stability and noise of the readout.")],
    )
