"""Speed against error: what a promised digit costs, for the solvers, the estimators and the live path."""

from __future__ import annotations

from .. import bench
from ._outcome import Check, Figure, Finding, Table
from ._subject import Subject

SIZES = (8, 16, 32)
SPECIMENS = 2
LIVE_FRAMES = 300
LIVE_CYCLES = 60


def solvers(_: Subject) -> Finding:
    """S1: time, true error and certified bound of every method on square arrays."""
    rows = list(bench.measure(SIZES, (1.0,), peers=False))
    methods = [row for row in rows if row.bound is not None and row.full_scale_error is not None]
    exact = [row.error for row in rows if row.method == "exact" and row.error is not None]
    return Finding(
        checks=[
            Check(
                "true error over certified bound, worst of all methods and sizes",
                max(
                    row.full_scale_error / row.bound
                    for row in methods
                    if row.bound and row.full_scale_error is not None
                ),
                1.0,
            ),
            Check(
                "exact method: error of the worst cell, relative to that cell",
                max(exact),
                1e-11,
            ),
        ],
        text=[
            "Arrays of cells between 10 kohm and 1 Mohm with 1 ohm per segment and lead, against an independent sparse "
            "factorisation. `ohmskin bench` measures the same beside other programs, with more sizes."
        ],
        figures=[Figure(bench.picture(rows), "Error against time, one curve per method, along the sizes.")],
        tables=[
            Table(
                ["array", "method", "time", "error of the worst cell", "of full scale", "certified bound"],
                [
                    [
                        f"{row.size} x {row.size}",
                        row.method + (f" ({row.note})" if row.note else ""),
                        "" if row.seconds is None else f"{1e3 * row.seconds:.3g} ms",
                        *(
                            "" if value is None else f"{value:.1e}"
                            for value in (row.error, row.full_scale_error, row.bound)
                        ),
                    ]
                    for row in rows
                ],
                "Measured in this run, on this machine.",
            )
        ],
    )


def estimators(_: Subject) -> Finding:
    """S2: error and cost of every estimator on a material that none of the models describes."""
    specimens = {
        f"{bench.INDEPENDENT}, specimen {seed + 1}": bench.estimators((bench.INDEPENDENT,), seed=seed)
        for seed in range(SPECIMENS)
    }
    checks = []
    for specimen, rows in specimens.items():
        default = next(row for row in rows if row.is_default)
        static = next(row for row in rows if row.estimator == "static")
        checks.append(
            Check(
                f"{specimen}: error of the default ({default.estimator}) over that of 'static'",
                default.rmse_percent / static.rmse_percent,
                1.1,
            )
        )
    return Finding(
        checks=checks,
        text=[
            "Each estimator is calibrated on 240 s of random presses and judged on others, half of them without "
            "holds. The material is relays with fractional creep, and shares nothing with the models in the product. "
            "Times are per cell and sample with 64 x 64 cells in motion."
        ],
        tables=[
            Table(
                ["material", "estimator", "RMSE, % of full scale", "µs per cell and sample"],
                [
                    [
                        specimen,
                        row.estimator + (" (default)" if row.is_default else ""),
                        f"{row.rmse_percent:.2f}",
                        f"{row.microseconds:.3f}",
                    ]
                    for specimen, rows in specimens.items()
                    for row in rows
                ],
                "Measured in this run, on this machine. `ohmskin bench --estimators` prints the first again.",
            )
        ],
    )


def live_path(_: Subject) -> Finding:
    """S3: frames per second, errors and ages on the way from a board's bytes to kPa."""
    rows = list(bench.live_estimators(SIZES, learned=False, frames=LIVE_FRAMES))
    skins = list(bench.freshness(SIZES, cycles=LIVE_CYCLES))
    checks = []
    for size in SIZES:
        here = [row for row in rows if row.size == size]
        default = next(row for row in here if row.is_default)
        static = next(row for row in here if row.estimator == "static")
        checks.append(
            Check(
                f"{size} x {size}: error of the default ({default.estimator}) over that of 'static'",
                default.rmse_kpa / static.rmse_kpa,
                1.0,
            )
        )
    unaccounted = float(sum(row.unaccounted for row in skins))
    checks.append(Check("frames that the board sent and that are in no count", unaccounted, 0.0))
    return Finding(
        checks=checks,
        text=[
            "Five fingers wander over the shipped example cell, on boards with inverting amplifiers, 12 bits and "
            "noise. Errors are those of valid cells, against the pressures that the fingers had. Frames per "
            "second are per second of processor time on one core, of a reader of a skin who takes every frame with "
            "its standard deviations. The age is that of the newest frame of a board "
            "at 1 kHz when a reader gets it who works for 10 ms in each cycle, without what line and operating "
            "system add. "
            "`ohmskin bench --driver` measures more sizes, other circuits and the estimators that learn."
        ],
        tables=[
            Table(
                ["array", "estimator", "frames/s", "packets", "ohms", "kPa", "std", "skin", "RMSE, kPa", "worst, kPa"],
                [
                    [
                        f"{row.size} x {row.size}",
                        row.estimator + (" (default)" if row.is_default else ""),
                        f"{row.frames_per_second:.0f}",
                        *(f"{100 * share:.0f} %" for share in row.shares),
                        f"{row.rmse_kpa:.3f}",
                        f"{row.worst_kpa:.2f}",
                    ]
                    for row in rows
                ],
                "Measured in this run, on this machine. Packets, ohms and kPa, each alone, are shares of a frame's "
                "time; std is that of standard deviations, skin the rest: bookkeeping and hand-over.",
            ),
            Table(
                ["array", "µs per frame that comes", "taken", "contacts besides", "age in frames, median", "worst"],
                [
                    [
                        f"{row.size} x {row.size}",
                        f"{row.come_us:.0f}",
                        f"{row.taken_us:.0f}",
                        f"{row.contacts_us:.0f}",
                        f"{row.median_age:.2f}",
                        f"{row.worst_age:.2f}",
                    ]
                    for row in skins
                ],
                "The same through a skin, with the default estimator.",
            ),
        ],
    )
