"""Recordings of emulated specimens outside the fitted model classes, for calibrations: a head is learned from.

A recording has a name ``LOAD | MATERIAL | SEED``, such as ``new speeds | maxwell | 0``: a load and a material of
:mod:`._materials`, and the seed of their parameters. :mod:`.scenarios` judges estimators on them.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

from ..cell import CalibrationResult, calibrate, checked_recording
from ..common.arrays import FloatArray
from ..errors import InputError
from ._materials import LOADS, MATERIALS

DT_S = 0.1
FULL_SCALE_KPA = 15.5
REST_OHM = 10000.0
NOISE = 0.002
"""standard deviation of a reading, relative to it, unless the disturbance says otherwise"""
DISTURBANCES = ("thinned", "noisy", "outliers", "R0 3 % low")
"""what happens to random presses"""


@dataclass(frozen=True)
class Specimen:
    """One recording (n,), of which the part before ``head_s`` is learned from."""

    name: str
    time_s: FloatArray
    pressure_kpa: FloatArray
    resistance_ohm: FloatArray
    head_s: float
    rest_factor: float = 1.0
    """by which R0 is wrong when the estimator is used"""

    def near_head(self, seconds: float) -> Specimen:
        """The last part of what is learned from, and the first of the rest."""
        near = np.abs(self.time_s - self.head_s) <= seconds
        first = self.time_s[near][0]
        return Specimen(
            self.name,
            self.time_s[near] - first,
            self.pressure_kpa[near],
            self.resistance_ohm[near],
            self.head_s - first,
            self.rest_factor,
        )

    @property
    def is_head(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """(n,) what is learned from."""
        return self.time_s < self.head_s

    def calibrated(self) -> CalibrationResult:
        """The calibration with defaults on the head."""
        arrays = (part[self.is_head] for part in (self.time_s, self.pressure_kpa, self.resistance_ohm))
        return calibrate(checked_recording(*arrays, name=self.name), full_scale_kpa=FULL_SCALE_KPA)

    def best_static_percent(self, full_scale_kpa: float) -> float:
        """RMSE after the head, in % of full scale, of the curve without memory that is best there.

        Cubics of R and of log R and a monotone curve are fitted to the head, and the best is chosen after the fact.
        """
        head = self.is_head
        load, log_ohm = self.pressure_kpa / full_scale_kpa, np.log(self.resistance_ohm)
        found = []
        for x in (log_ohm, self.resistance_ohm / np.median(self.resistance_ohm)):
            curve, _ = np.polynomial.Polynomial.fit(x[head], load[head], 3, full=True)
            inside = np.clip(x, x[head].min(), x[head].max())
            found.append(np.clip(curve(inside), load[head].min(), 1.2))
        order = np.argsort(log_ohm[head])
        rises = bool(np.corrcoef(log_ohm[head], load[head])[0, 1] > 0)
        monotone = isotonic_regression(load[head][order], increasing=rises).x
        found.append(np.interp(log_ohm, log_ohm[head][order], monotone))
        return min(100 * float(np.sqrt(np.mean((curve - load)[~head] ** 2))) for curve in found)


def is_name(name: str) -> bool:
    """Whether a text has the form of a recording's name."""
    return name.count(" | ") == 2


def specimen(name: str) -> Specimen:
    """The recording of a name; the same for the same name.

    Raises:
        InputError: there is no such load or material, or the seed is no number.

    """
    load, material, seed = name.split(" | ")
    loads = [*LOADS, *DISTURBANCES]
    if load not in loads or material not in MATERIALS or not seed.isdecimal():
        expected = f"LOAD of {', '.join(loads)}; MATERIAL of {', '.join(MATERIALS)}"
        raise InputError(f"no recording '{name}'; expected LOAD | MATERIAL | SEED with a {expected}")
    rng = np.random.default_rng([int(seed), zlib.crc32(f"{load}, {material}".encode())])
    loads_of, head_s = LOADS["random" if load in DISTURBANCES else load](rng, DT_S)
    r = MATERIALS[material](loads_of, DT_S, rng)
    noise = 0.01 if load == "noisy" else NOISE
    read = REST_OHM * (1 + r) * (1 + noise * rng.standard_normal(len(r)))
    if load == "outliers":
        read[rng.random(len(read)) < 0.005] *= 1.3
    kept = slice(None, None, 3 if load == "thinned" else 1)
    return Specimen(
        name=name,
        time_s=(DT_S * np.arange(float(len(read))))[kept],
        pressure_kpa=(FULL_SCALE_KPA * loads_of)[kept],
        resistance_ohm=read[kept],
        head_s=head_s,
        rest_factor=0.97 if load == "R0 3 % low" else 1.0,
    )
