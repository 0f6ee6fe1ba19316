"""Plausibility checks of a calibration recording (clock lead, clipping, units, gaps, drift), as remarks in a report."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ._fitted import Drift
from ._recording import Recording

LONGEST_LEAD_S = 5.0
"""longest lead that is searched"""
LEAD_S, LEAD_STEPS = 0.03, 3.0
"""least shift of the two that is reported, in seconds and in time steps of the recording"""
MOST_STEPS = 200_000
"""largest number of samples of the raster on which a lead is searched"""
CLEARLY = 0.3
"""least correlation of the two signals' changes for a lead to be believed"""
AT_LIMIT = 0.02
"""fraction of the readings under load with the same extreme value, above which readings look clipped"""
USUAL_KPA, USUAL_OHM = (0.5, 1000.0), (30.0, 1e9)
"""ranges of the full scales and median resistances of robot skins; values outside are perhaps in another unit"""
USUAL_STEP_S = 2.0
"""longest time between readings that still resolves a press of a few seconds"""
FALLS, RISES = 0.03, 0.08
"""least relative drift of R0 that is reported. Creep under load alone can look like a rise by 0.06 (specimens of relays
with fractional creep, `bench/_materials.py`), but hardly like a fall"""
DRIFT_ERRORS, DRIFT_LEAVES = 4.0, 0.3
"""a drift is believed if it exceeds the first number of standard errors, and reduces the squared error beyond noise to
less than the second fraction"""
GAP_SHARE, GAP_STEPS = 0.05, 20.0
"""least gap that is reported: over the length of the recording, and in its time steps"""
LOADED, DIFFERENT = 0.3, 0.2
"""fractions of full scale: load above which a cell counts as loaded here; and least range of loads with the same
reading that indicates clipping"""


def remarks(
    recording: Recording, full_scale_kpa: float, presses: float, *, varied: bool, drift: Drift | None = None
) -> Iterator[str]:
    """Remarks, one sentence each.

    Args:
        recording: the calibration recording.
        full_scale_kpa: full scale of the cell.
        presses: path of the load, in presses to full scale.
        varied: whether held-out parts of the recording differ from each other.
        drift: drift of R0 as fitted with a model; None: not fitted.
    """
    if drift is not None and believed(drift):
        yield (
            f"R0 drifts by {100 * drift.share:+.0f} % over the recording, which creep of the model does not explain: "
            "does the temperature change, or a lead loosen? Estimates drift with it; "
            "record again when R0 is steady"
        )
    lead = clock_shift_s(recording)
    if lead > 0:  # a lag can be a property of the cell, as many follow the pressure late; a lead cannot
        yield (
            f"the resistance changes {lead:.2g} s before the pressure does: is the load cell late, or are the clocks "
            "apart? The delay is taken for a property of the cell"
        )
    share = clipped_share(recording, full_scale_kpa)
    if share > AT_LIMIT:
        yield (
            f"{100 * share:.0f} % of the readings under load are the same extreme value: does the converter clip? "
            "Loads beyond it cannot be told apart"
        )
    yield from _unusual(recording, full_scale_kpa)
    gap_s, length_s = float(np.diff(recording.time_s).max()), float(np.ptp(recording.time_s))
    unknown_s = float(np.diff(recording.loads.time_s).max())
    clear_s = max(GAP_SHARE * length_s, GAP_STEPS * recording.step_s)
    if unknown_s > clear_s:
        yield (
            f"nothing was read for {unknown_s:.3g} s of {length_s:.3g} s: the load is taken to have gone straight from "
            "the reading before to the one after, and what the cell remembers of that time is wrong if it did not"
        )
    elif gap_s > clear_s:
        yield (
            f"the resistance was not read for {gap_s:.3g} s of {length_s:.3g} s: models of the cell follow the load of "
            "that time, but the learned map learns nothing from it"
        )
    highest = float(recording.pressure_kpa.max())
    if highest > 1.2 * full_scale_kpa:
        yield (
            f"the largest load is {highest:.3g} kPa, full scale {full_scale_kpa:.3g} kPa: was it hardly ever reached? "
            "--full-scale sets it"
        )
    if highest < 0.8 * full_scale_kpa:
        yield f"the largest load is {highest:.3g} of {full_scale_kpa:.3g} kPa: beyond it the deviation grows fast"
    if presses < 3:
        yield f"the load amounts to {presses:.1f} full presses: little is known of others, and the deviation says so"
    elif not varied:
        yield "the presses are all alike: little is known of others, and the deviation says so"


def _unusual(recording: Recording, full_scale_kpa: float) -> Iterator[str]:
    """Remarks on values that are perhaps in another unit; :mod:`._recording` refuses values that surely are."""
    if recording.step_s > USUAL_STEP_S:
        yield f"readings {recording.step_s:.3g} s apart hardly show how a press begins: is time_s in milliseconds?"
    low, high = USUAL_KPA
    if not low <= full_scale_kpa <= high:
        unit = "MPa or bar" if full_scale_kpa < low else "Pa or mbar"
        yield f"a full scale of {full_scale_kpa:.3g} kPa is unusual for a skin: is pressure_kpa in {unit}?"
    median_ohm = float(np.median(recording.resistance_ohm))
    low, high = USUAL_OHM
    if not low <= median_ohm <= high:
        unit = "kohm" if median_ohm < low else "mohm"
        yield f"a resistance of {median_ohm:.3g} ohm is unusual for a skin: is resistance_ohm in {unit}?"


def believed(drift: Drift) -> bool:
    """Whether a fitted drift of R0 is large and significant.

    Creep that is missing in the model looks like a drift, too. But a steady drift of R0 explains little of such creep.
    """
    large = drift.share < -FALLS or drift.share > RISES
    return large and abs(drift.share) > DRIFT_ERRORS * drift.std_error and drift.unexplained < DRIFT_LEAVES


def clock_shift_s(recording: Recording) -> float:
    """By how many seconds the resistance changes before the pressure (negative: after it); 0: not clear.

    This is where the cross-correlation of their changes is largest, whether loads raise the resistance or lower it.
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import correlate

    step = recording.step_s
    time = np.arange(recording.time_s[0], recording.time_s[-1], step)
    if len(time) > MOST_STEPS:
        return 0.0
    pressure = np.interp(time, recording.time_s, recording.pressure_kpa)
    log_ohm = np.interp(time, recording.time_s, np.log(recording.resistance_ohm))
    width = max(1.0, LEAD_S / step / 3)
    rates = [np.gradient(gaussian_filter1d(signal, width)) for signal in (pressure, log_ohm)]
    most = min(round(LONGEST_LEAD_S / step), len(time) // 4)
    late, early = (rate - rate.mean() for rate in rates)
    middle = len(time) - 1
    product = correlate(late, early, method="fft")[middle - most : middle + most + 1]
    found = np.abs(product) / max(float(np.linalg.norm(late) * np.linalg.norm(early)), 1e-300)
    lead = int(np.argmax(found)) - most
    far_enough = abs(lead) * step >= LEAD_S and abs(lead) >= LEAD_STEPS
    return lead * step if far_enough and found.max() > CLEARLY else 0.0


def clipped_share(recording: Recording, full_scale_kpa: float) -> float:
    """Fraction of the readings under load that equal the largest or smallest one, although their loads differ."""
    load = recording.pressure_kpa / full_scale_kpa
    loaded, load = recording.resistance_ohm[load > LOADED], load[load > LOADED]
    shares = [0.0]
    if loaded.size:
        for extreme in (loaded.max(), loaded.min()):
            there = loaded == extreme
            if np.ptp(load[there]) > DIFFERENT:
                shares.append(float(np.mean(there)))
    return max(shares)
