"""Speed against error: what a promised digit costs, for the solvers and for the estimators."""

from __future__ import annotations

from .. import bench
from ._outcome import Check, Figure, Finding, Table
from ._subject import Subject

SIZES = (8, 16, 32)
SPECIMENS = 2


def solvers(_: Subject) -> Finding:
    """S1: time, true error and certified bound of every method on square arrays."""
    rows = list(bench.measure(SIZES, (1.0,), memory=False, peers=False))
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
            "factorisation. `ohmskin bench` measures the same beside other programs, with more sizes and memory."
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
            "Each estimator is calibrated by the 280 s protocol alone and judged on random presses. The material is "
            "relays with fractional creep, and shares nothing with the models in the product. Times are per cell and "
            "sample with 64 x 64 cells in motion."
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
