"""What the readings allow: the least pressure that can be shown at rest, one second after a load is released.

``python -m ohmskin.bench.oracle`` prints it beside that of the frozen estimator, for every row of ``scenarios.toml``
where that shows more than its limit. The oracle knows the true path of the load up to its release, and thereby the
state of the cell. It does not know whether the load then is zero or stays at a plateau of any height up to full scale,
which have even odds. The posterior of that height is exact: r is linear in it, and noise is white and normal.
"""

from __future__ import annotations

import numpy as np

from ..cell import Cell, PaperModel
from ..common.arrays import FloatArray
from .scenarios import REST_AFTER_S, rows
from .scenes import LOADS, SUBSTEPS, Played, Scene, cells, play

HEIGHTS = np.linspace(0.0, 1.0, 2001)
"""of plateaus, in full scales"""


def plateau(error: FloatArray, std: FloatArray, gain: FloatArray) -> tuple[float, float]:
    """Posterior mean of a plateau that is there with even odds, and the deviation of its height by the readings alone.

    Args:
        error: (n,) readings beyond those of no load.
        std: (n,) of their noise.
        gain: (n,) of the plateau.

    """
    precision = float(np.sum((gain / std) ** 2))
    height = float(np.sum(gain * error / std**2)) / precision
    fit = -0.5 * precision * HEIGHTS * (HEIGHTS - 2.0 * height)  # logarithm of the density, over that of no load
    density = np.exp(fit - fit.max())
    at_rest = len(HEIGHTS) * float(np.exp(-fit.max()))
    return float(density @ HEIGHTS) / (at_rest + float(density.sum())), precision**-0.5


def releases(scene: Scene, played: Played, cell: Cell) -> list[tuple[float, float]]:
    """Of each release that no load follows for a second: what :func:`plateau` says then, in full scales."""
    model, full = cell.model, cell.full_scale_kpa
    assert isinstance(model, PaperModel)
    dt_s, frames = played.frame_s, round(REST_AFTER_S / played.frame_s)
    fine = LOADS[scene.load].share(dt_s / SUBSTEPS * np.arange(1.0, len(played.pressure_kpa) * SUBSTEPS + 1), dt_s)
    exact = cell.forward(fine.shape[1:]).run(np.full(len(fine), dt_s / SUBSTEPS), fine * full)[SUBSTEPS - 1 :: SUBSTEPS]
    r, read = (ohm.reshape(len(exact), -1) / cell.rest_resistance_ohm - 1.0 for ohm in (exact, played.ohms))
    noise = np.hypot(played.noise_siemens, played.step_siemens / 12**0.5) * cell.rest_resistance_ohm
    since_s = dt_s * np.arange(1, frames + 1)
    late_2, late_3 = (-np.expm1(-since_s / lasts_s) for lasts_s in (model.t2_s, model.t3_s))
    gain = full * (1.0 / model.e1_kpa + late_2 / model.e2_kpa + late_3 / model.e3_kpa)
    loaded, found = played.pressure_kpa.reshape(len(exact), -1) > 0.0, []
    for frame, i in np.argwhere(loaded[:-1] & ~loaded[1:]).tolist():
        after = slice(frame + 1, frame + 1 + frames)
        seen = np.isfinite(read[after, i])
        if seen.size == frames and seen.any() and not loaded[after, i].any():
            std = (1.0 + r[after, i]) ** 2 * noise
            found.append(plateau((read - r)[after, i][seen], std[seen], gain[seen]))
    return found


def main() -> None:
    """Print the table."""
    print(f"{'rest, % of full scale: frozen, the least that readings allow, deviation':72s}")
    for row in rows():
        limit = row.limits.rest_percent
        if row.scene is None or row.today is None or limit is None or not row.today.rest > limit:
            continue
        cell = cells()[row.scene.cell]
        if not isinstance(cell.model, PaperModel) or row.scene.fault:
            continue
        found = releases(row.scene, play(row.scene), cell)
        least, std = np.max(np.array(found), axis=0) if found else (np.nan, np.nan)
        print(f"{row.name:72s} {row.today.rest:6.1f} {100 * least:6.1f} {100 * std:6.1f}")


if __name__ == "__main__":
    main()
