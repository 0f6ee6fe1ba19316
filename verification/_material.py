"""P1 to P9: the mixture and the cell's models against what the paper states, and the estimate of the pressure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import signal

from ..cell import READING_NOISE, Cell, ContactModel, PaperModel, estimate_recording, recovery_branches
from ..common import plots
from ..common.arrays import FloatArray
from ..errors import InputError
from ._claim import statement
from ._dut import DesignUnderTest
from ._explore import KNOWN_FRACTION, mixtures, resolution_kpa
from ._outcome import Check, DoesNotApply, Finding, Table
from ._pictures import curves, picture, pressures
from ._pressures import FASTEST_HZ, one_cell_read
from ._quantity import NOMINAL

STEP_KPA = 15.5  # 10.0 N on one square inch (V.A)
EDGE_S = 0.1  # time in which a press is applied and released
SETTLED_S = 1e-6  # time before the first sample in which the first pressure is applied
PAPERS = "the paper's"
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


@statement(
    *("P2", "Bonded and touching electrodes", "III, Figs. 4, 5"),
    "With electrodes cast in, resistance rises with pressure and shows the material's viscoelastic shape; with "
    "electrodes that merely touch, contact resistance dominates and falls.",
)
def electrodes(dut: DesignUnderTest) -> Finding:
    contact = Cell(
        rest_resistance_ohm=dut.rest * 20,
        full_scale_kpa=dut.full_scale_kpa,
        model=ContactModel(full_scale_resistance_ohm=dut.rest),
    )
    time_s, pressure = pressed([(5, STEP_KPA, 20.0)], 60.0)
    bonded_ohm, contact_ohm = (respond(cell, time_s, pressure) for cell in (dut.cell, contact))
    released = time_s > 25 + 5 * EDGE_S
    loads = np.geomspace(0.05, 1.0, 20) * dut.full_scale_kpa
    ohms = contact.forward(loads.shape).step(1.0, loads)
    slope = float(np.polyfit(np.log(loads), np.log(1 / ohms - 1 / contact.rest_resistance_ohm), 1)[0])

    def draw(panels: Any) -> None:
        values = {"electrodes cast in": bonded_ohm, "electrodes touching": contact_ohm}
        for panel, (title, ohms) in zip(panels[0], values.items(), strict=True):
            panel.plot(time_s, ohms / 1e3)
            panel.axvspan(5, 25, color=plots.INK, alpha=0.06, lw=0)
            panel.set(title=title, xlabel="time / s", ylabel="resistance / kΩ", ylim=(0, None))

    rise = 100 * (np.median(bonded_ohm[(time_s > 15) & (time_s < 25)]) / bonded_ohm[0] - 1)
    fall = 100 * (np.median(contact_ohm[(time_s > 15) & (time_s < 25)]) / contact_ohm[0] - 1)
    return Finding(
        checks=[
            Check("bonded: resistance rises under load by", float(rise), 0.0, "%", at_least=True),
            Check("touching: resistance falls under load by", float(-fall), 0.0, "%", at_least=True),
            Check(
                "bonded: what is left just after release, of the held change",
                float(1e4 * (bonded_ohm[released][0] / bonded_ohm[0] - 1) / rise),
                5.0,
                "%",
                at_least=True,
            ),
            Check(
                "touching: what is left just after release",
                float(100 * abs(contact_ohm[released][0] / contact_ohm[0] - 1)),
                1e-9,
                "%",
            ),
            Check("touching: exponent n of R ~ F^-n, at least", slope, 0.7, at_least=True),
            Check("touching: exponent n of R ~ F^-n, at most", slope, 1.3),
        ],
        text=[
            "The same press on both kinds of cell. Bonded electrodes show the bulk, which breaks conductive paths and "
            "remembers; touching ones show the contact, a static power law of the force (published exponents 0.7 to "
            "1.3). The contact cell's two resistances are the project's own choice."
        ],
        figures=picture(f"Grey: {STEP_KPA} kPa applied.", draw, 1, 2),
    )


@statement(
    *("P3", "Resistance follows strain", "(1), (2)"),
    "The change of resistance is proportional to strain, so resistance is a function of stress.",
)
def strain(dut: DesignUnderTest) -> Finding:
    time_s, pressure = pressed([(1, 1.0, 5.0)], 30.0)
    scales = np.array([0.1, 0.5, 1.0])
    rests = np.array([1e2, 1e4, 1e6])
    cell = dut.cell
    unit = respond(cell, time_s, pressure) / cell.rest_resistance_ohm - 1
    worst_scale = max(
        float(np.abs((respond(cell, time_s, k * pressure) / cell.rest_resistance_ohm - 1) / k - unit).max())
        for k in scales
    )
    several = respond(cell, time_s, pressure, rests) / rests - 1
    worst_rest = float(np.abs(several - unit[:, None]).max())
    return Finding(
        checks=[
            Check("r of a scaled load, divided by the scale: worst deviation", worst_scale / unit.max(), 1e-9),
            Check("r of cells from 100 ohm to 1 Mohm under one load: worst deviation", worst_rest / unit.max(), 1e-9),
        ],
        text=["r is dimensionless, the stress is in kPa; E and eta are then in kPa, kPa s and kPa/s."],
    )


@statement(
    *("P4", "Rising phase", "(3), Fig. 6"),
    "Under load: a jump, an overshoot, then slow settling, as a gain plus a first-order term in the stress rate.",
)
def rising(dut: DesignUnderTest) -> Finding:
    model = _paper_model(dut)
    (numerator, denominator), edge = model.rising_transfer_function(), 1e-3
    time_s = np.r_[0.0, edge + np.linspace(0.0, 8 * model.tu_s, 400)]
    pressure = np.minimum(time_s / edge, 1.0) * STEP_KPA
    r = respond(dut.cell, time_s, pressure) / dut.rest - 1
    grid = np.arange(0.0, time_s[-1], edge)  # lsim takes evenly spaced, piecewise-linear inputs
    _, filtered, _ = signal.lsim((numerator, denominator), np.minimum(grid / edge, 1.0) * STEP_KPA, grid)
    expected = np.interp(time_s, grid, filtered)
    deviation = float(np.abs(r - expected)[time_s <= grid[-1]].max() / expected.max())
    settled = STEP_KPA / model.eu1_kpa
    printed = model.eu1_kpa / (model.eu1_kpa * model.eu2_kpa_per_s)

    def draw(panels: Any) -> None:
        panel = panels[0, 0]
        panel.plot(grid, filtered, lw=4, alpha=0.3, color=plots.INK, label="equation (3), scipy.signal.lsim")
        panel.axhline(settled, color=plots.ORANGE, lw=1, ls="--", label="σ / Eu1")
        title = f"Step of {STEP_KPA} kPa"
        curves(panel, time_s, {"forward model": r}, title=title, xlabel="time / s", ylabel="r", ylim=(0, None))

    return Finding(
        checks=[
            Check("forward model against (3): worst deviation, of the peak", deviation, 1e-3),
            Check("overshoot against 1 + Eu1/etau2", abs(r.max() / settled / model.overshoot - 1), 1e-3),
            Check("settled value against 1/Eu1", abs(r[-1] / settled - 1), 1e-3),
        ],
        text=[
            "The second form of (3) printed in the paper has the constant Eu1 in its numerator; its own two terms add "
            f"up to Eu2. As printed, the gain at rest would be 1/Eu2 = {printed:.4g} instead of 1/Eu1 = "
            f"{1 / model.eu1_kpa:.4g} per kPa. The corrected form is used."
        ],
        figures=picture("A jump, an overshoot, then slow settling, as in Fig. 6.", draw),
    )


@statement(
    *("P5", "Recovery phase", "(4)-(8), Figs. 7, 8"),
    "After unloading: an augmented Burgers model of five elements, which always returns to R0.",
)
def recovery(dut: DesignUnderTest) -> Finding:
    model = _paper_model(dut)
    numerator, denominator = model.transfer_function()
    omega = np.geomspace(1e-5, 1e3, 400)
    _, printed = signal.freqs(numerator, denominator, omega)
    s = 1j * omega
    summed = 1 / model.e1_kpa + 1 / (model.eta2_kpa_s * s + model.e2_kpa) + 1 / (model.eta3_kpa_s * s + model.e3_kpa)
    time_s, r = _release(dut)
    branches = {
        "elastic, 1/E1": np.zeros_like(time_s),
        f"T2 = {model.t2_s:.3g} s": np.exp(-time_s / model.t2_s) / model.e2_kpa,
        f"T3 = {model.t3_s:.3g} s": np.exp(-time_s / model.t3_s) / model.e3_kpa,
    }
    expected = STEP_KPA * sum(branches.values())

    def draw(panels: Any) -> None:
        panel = panels[0, 0]
        panel.plot(time_s, r, color=plots.INK, lw=2, label="total")
        scaled = {label: STEP_KPA * branch for label, branch in branches.items()}
        labels = {"title": "Release after a long hold", "xlabel": "time after release / s", "ylabel": "r"}
        curves(panel, time_s, scaled, xlim=(0, 120), **labels)

    return Finding(
        checks=[
            Check("(4)-(7) against (8): worst relative deviation", float(np.abs(printed / summed - 1).max()), 1e-12),
            Check(
                "forward model against the sum of its branches, of the held value",
                float(np.abs(r - expected).max() * model.eu1_kpa / STEP_KPA),
                1e-3,
            ),
            Check("left after ten times T3, of the held value", float(abs(r[-1]) * model.eu1_kpa / STEP_KPA), 1e-4),
        ],
        figures=picture("Recovery and its components in series, as in Fig. 8.", draw),
    )


@statement(
    *("P6", "Coefficients from the recovery curve", "(9)"),
    "E_i is the inverse gain of each branch of the recovery curve, eta_i = T_i E_i.",
)
def identification(dut: DesignUnderTest) -> Finding:
    model = _paper_model(dut)
    time_s = np.linspace(0.0, 3 * model.t3_s, 600)  # five minutes of the example cell, as a person would record it
    r = np.interp(time_s, *_release(dut))
    recorded = np.r_[STEP_KPA * model.gain_per_kpa, r]
    moments = np.r_[0.0, 1e-3 + time_s]
    rng = np.random.default_rng(6)
    noises = 1 + 0.001 * rng.standard_normal((25, len(recorded)))
    truth = (model.e1_kpa, model.e2_kpa, model.e3_kpa, model.t2_s, model.t3_s)
    names = ("E1 / kPa", "E2 / kPa", "E3 / kPa", "T2 / s", "T3 / s")
    read = [recovery_branches(moments, (1 + recorded) * noise - 1, STEP_KPA) for noise in noises]
    found: dict[str, Sequence[float]] = {
        "without noise": recovery_branches(moments, recorded, STEP_KPA),
        "0.1 % noise on R": np.median(read, axis=0).tolist(),
    }
    off = {
        case: max(abs(value / true - 1) for value, true in zip(values, truth, strict=True))
        for case, values in found.items()
    }
    noisy = 100 * off["0.1 % noise on R"]

    def draw(panels: Any) -> None:
        _, e2, e3, t2, t3 = found["without noise"]
        panel = panels[0, 0]
        panel.semilogy(time_s, r, color=plots.INK, lw=2, label="recovery curve")
        panel.semilogy(time_s, STEP_KPA / e3 * np.exp(-time_s / t3), "--", label="slow branch: 1/E3, T3")
        panel.semilogy(time_s, STEP_KPA / e2 * np.exp(-time_s / t2), "--", label="fast branch: 1/E2, T2")
        panel.set(title="Branches of the recovery curve", xlabel="time after release / s", ylabel="r")
        panel.set(xlim=(0, 120), ylim=(1e-3, 1))
        panel.legend()

    return Finding(
        checks=[
            Check("coefficients read without noise: worst error", 100 * off["without noise"], 5.0, "%"),
            # Reading by eye is where a fit starts from: within a factor of 1.5 will do.
            Check("coefficients read with 0.1 % noise on R: median error, worst of five", noisy, 50.0, "%"),
        ],
        text=[
            "Straight lines in the logarithm of the recovery curve: the slow branch from its end, the fast one from "
            "what is left, the elastic one from what went at once. `ohmskin fit` starts from these values and then "
            "fits all data."
        ],
        figures=picture("The recovery curve taken apart, as in Fig. 8.", draw),
        tables=[
            Table(
                ["coefficient", "true", *found],
                [
                    [name, f"{true:.4g}", *(f"{values[k]:.4g}" for values in found.values())]
                    for k, (name, true) in enumerate(zip(names, truth, strict=True))
                ],
            ),
        ],
    )


@statement("P7", "Recovery times", "IV", "Up to 25 s to 95 % recovery, up to 5 minutes to full recovery.")
def recovery_times(dut: DesignUnderTest) -> Finding:
    time_s, r = _release(dut)
    left = r / (STEP_KPA * _paper_model(dut).gain_per_kpa)
    to_95 = float(np.interp(-0.05, -left, time_s))
    at_5_minutes = float(100 * np.interp(300.0, time_s, left))
    return Finding(
        checks=[
            Check("time to 95 % recovery", to_95, 25.0, "s"),
            Check("time to 95 % recovery is not short", to_95, 12.5, "s", at_least=True),
            Check("left after 5 minutes", at_5_minutes, 0.5, "%"),
        ],
        text=["The shipped example cell, released after a hold long enough to reach equilibrium."],
    )


@statement(
    *("P8", "Pressure by inverse filters", "V, Fig. 9"),
    "Pressure is the inverse filter of resistance, switched between two models by thresholds on its derivative.",
)
def inverse_filter(dut: DesignUnderTest) -> Finding:
    model = _paper_model(dut)
    time_s, pressure = pressed([(2, STEP_KPA, 15.0)], 60.0)
    ohms = respond(dut.cell, time_s, pressure)
    estimates = side_by_side(dut, time_s, ohms)
    rising_per_s, falling_per_s = model.thresholds_per_s(dut.full_scale_kpa)
    slope = np.gradient(ohms / dut.rest, time_s)

    def draw(panels: Any) -> None:
        panel, limits = panels[0, 0], (5 * falling_per_s, 5 * rising_per_s)
        panel.plot(time_s, slope, lw=1)
        for level in (rising_per_s, falling_per_s):
            panel.axhline(level, color=plots.RED, lw=1, ls="--")
        panel.set(title="Derivative of r and the thresholds", ylabel="dr/dt / s⁻¹", ylim=limits)
        pressures(panels[1, 0], time_s, pressure, estimates)

    settling = model.settling_slope_per_s(dut.full_scale_kpa)
    return Finding(
        checks=[
            Check("RMSE without noise", rmse(estimates[PAPERS], pressure, dut), 2.0, "% of full scale"),
            Check(
                "recovery threshold over the settling slope of a held load",
                -falling_per_s / settling,
                1.0,
                at_least=True,
            ),
        ],
        text=[
            "The paper leaves three things open. State hand-over at a switch: pressure and resistance stay where they "
            "are. Between the thresholds: the last model stays. The recovery threshold: it must exceed the slope at "
            "which a held load settles, σ Eu2/etau2², or holding reads as release."
        ],
        figures=picture("The switch at work, as in Fig. 9. Dashed: the thresholds.", draw, 2, height=4.2, sharex=True),
    )


@statement(
    *("P9", "One step and three steps", "V.A, Figs. 10, 11"),
    "The estimate follows the applied stress for a 15.5 kPa step, and for three in a row with creep.",
)
def steps(dut: DesignUnderTest) -> Finding:
    presses = {
        "one step": ([(5.0, STEP_KPA, 20.0)], 90.0),
        "three steps": ([(5.0 + 25.0 * k, STEP_KPA, 12.0) for k in range(3)], 110.0),
    }
    limit, checks, shown = dut.design.requirements.pressure_rmse_percent, [], {}
    for title, (profile, duration) in presses.items():
        time_s, pressure = pressed(profile, duration)
        true_ohm = respond(dut.cell, time_s, pressure)
        read_ohm, lost = one_cell_read(dut, true_ohm)
        zero = float(np.median(read_ohm[time_s < 4.0]))  # R0 as a user has it: read at rest, by the same readout
        estimates = side_by_side(dut, time_s, read_ohm, zero)
        shown[title] = time_s, pressure, true_ohm, read_ohm, estimates
        checks.append(Check(f"{title}: readings lost to a limit", 100 * lost, 0.0, "%"))
        for label, kpa in estimates.items():
            error = rmse(kpa, pressure, dut)
            checks.append(Check(f"{title}, {label}: RMSE", error, limit, "% of full scale"))
            peak = 100 * float(np.abs(kpa - pressure).max()) / dut.full_scale_kpa
            checks.append(Check(f"{title}, {label}: peak error", peak, 8 * limit, "% of full scale"))

    def draw(panels: Any) -> None:
        for (top, below), (title, press) in zip(panels.T, shown.items(), strict=True):
            time_s, pressure, true_ohm, read_ohm, estimates = press
            top.plot(time_s, true_ohm / 1e3, color=plots.INK, lw=4, alpha=0.25, label="cell")
            curves(top, time_s, {"as read": read_ohm / 1e3}, title=title, ylabel="resistance / kΩ")
            pressures(below, time_s, pressure, estimates)

    caption = "One press of 15.5 kPa (Fig. 10) and three in a row with creep (Fig. 11)."
    return Finding(
        checks=checks,
        text=[
            "The cell is read by the design under verification, among cells at rest, with the design's noise, the "
            "settling of its frame rate and its converter; R0 is the median of the first "
            "four seconds. Presses and releases take 0.1 s. The paper's estimator knows the cell's parameters to the "
            "letter; ours is what `ohmskin fit` chooses and finds in a recording of the calibration protocol with "
            f"{100 * READING_NOISE:g} % noise. `ohmskin bench --estimators` has them on a material without a model."
        ],
        figures=picture(caption, draw, 2, 2, height=4.6, sharex="col"),
    )


def _resolution(dut: DesignUnderTest, fractions: FloatArray, factors: FloatArray) -> FloatArray:
    """Pressure resolution (fractions,) in % of full scale, the reference resistor times factors; inf beyond limits."""
    pairs = zip(factors.tolist(), fractions.tolist(), strict=True)
    each = ({"reference resistor": factor, "carbon black": fraction} for factor, fraction in pairs)
    return np.array([100 * resolution_kpa(dut, changes, NOMINAL) / dut.full_scale_kpa for changes in each])


def _paper_model(dut: DesignUnderTest) -> PaperModel:
    if not isinstance(dut.cell.model, PaperModel):
        raise InputError(f"this experiment needs a cell of kind 'paper', got '{dut.cell.model.kind}'")
    return dut.cell.model


def _release(dut: DesignUnderTest) -> tuple[FloatArray, FloatArray]:
    """r (samples,) after a release within 1 ms from equilibrium, at ``time_s`` after it."""
    model = _paper_model(dut)
    forward = dut.cell.forward((1,))
    load = np.array([STEP_KPA])
    forward.step(1.0, load)
    forward.step(1e3 * model.t3_s, load)
    first = forward.step(1e-3, np.zeros(1))
    time_s = np.r_[0.0, np.geomspace(1e-2, max(300.0, 10 * model.t3_s), 600)]
    samples = [first] + [forward.step(dt, np.zeros(1)) for dt in np.diff(time_s)]
    return time_s, np.array(samples)[:, 0] / dut.rest - 1


def pressed(presses: list[tuple[float, float, float]], duration_s: float) -> tuple[FloatArray, FloatArray]:
    """Presses (start s, kPa, length s) as samples at FASTEST_HZ."""
    time_s = np.arange(0.0, duration_s, 1 / FASTEST_HZ)
    pressure = np.zeros_like(time_s)
    for start, kpa, length in presses:
        corners = [start, start + EDGE_S, start + length, start + length + EDGE_S]
        pressure += np.interp(time_s, corners, [0.0, kpa, kpa, 0.0])
    return time_s, pressure


def respond(cell: Cell, time_s: FloatArray, pressure: FloatArray, rest: FloatArray | None = None) -> FloatArray:
    """Resistance (samples,) of one cell, or (samples, cells) of several with their own R0."""
    shape = (1,) if rest is None else rest.shape
    forward = cell.forward(shape, rest_resistance_ohm=rest)
    loads = np.broadcast_to(pressure[:, None], (len(pressure), *shape))
    ohms = forward.run(np.diff(time_s, prepend=time_s[0] - SETTLED_S), loads)
    return ohms[:, 0] if rest is None else ohms


def side_by_side(
    dut: DesignUnderTest, time_s: FloatArray, ohms: FloatArray, rest: float | None = None
) -> dict[str, FloatArray]:
    """kPa (samples,) by label, from a reading of the design's cell; ``rest`` replaces R0."""
    estimators = {PAPERS: (dut.cell, "paper"), f"ours ({dut.ours})": (dut.calibrated, dut.ours)}
    return {
        label: estimate_recording(cell.estimator((), name, rest_resistance_ohm=rest), time_s, ohms)[0]
        for label, (cell, name) in estimators.items()
    }


def rmse(estimate: FloatArray, truth: FloatArray, dut: DesignUnderTest) -> float:
    """% of full scale."""
    return float(100 * np.sqrt(np.mean((estimate - truth) ** 2)) / dut.full_scale_kpa)
