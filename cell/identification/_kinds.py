"""Parametrisations of the cell models for least squares: free parameters, bounds, starts, and simulation of each kind.

Three kinds are nested: asymmetric branches; then with a curved static response and slow charging ("whole"); then with
conductive chains that break ("m10"). The solution of one kind can therefore start the next. The paper's model is not
part of this nesting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pydantic import ValidationError

from ...common.arrays import FloatArray
from ...errors import InputError
from ..inversions import play_follow
from ..materials import M10_PARAMETERS, AsymmetricModel, M10Model, Model, PaperModel, simulate

INSTANT_S, RISE2_S = 0.05, 1.0
"""charging time constants in seconds: of a branch that charges at once, and the usual one of the slow branch"""
DRIFTS = 1.0
"""bound of a fitted drift over the recording, over R0, in either direction"""


@dataclass(frozen=True)
class Kind:
    """A kind of model as a least-squares problem: free parameters, bounds, starts."""

    kind: str
    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    starts: tuple[tuple[float, ...], ...]
    """the first holds the usual values for this range of r, and is the centre of the prior"""
    size: float
    """range of r in the recording"""
    fixed: tuple[float, ...] = ()
    """values of :data:`..materials.M10_PARAMETERS`; NaN where a free parameter stands. (): the paper's model"""
    begun: int = 0
    """number of parameters, after the named ones, for the initial memory of branches and chains"""
    drifts: bool = False
    """whether the last named parameter is a drift of R0 over the recording, over R0"""

    def felt(self, load: FloatArray) -> FloatArray:
        """The load (n,) or (n, m) as :meth:`run` takes it, (n, 1) or (n, m), for any number of parameter sets."""
        columns = load[:, None] if load.ndim == 1 else load
        if self.fixed:
            return columns
        return play_follow(columns, 4 * simulate.white_noise(columns[:, 0]))  # noise would switch the phase

    def run(self, parameters: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
        """r (n, m), without the offset of R0, for ``parameters`` (p, m) under a load as :meth:`felt`."""
        named, begun = parameters[: len(self.names) - self.drifts], parameters[len(self.names) :]
        if not self.fixed:
            r = simulate.paper(named, load, dt_s)
        else:
            full = np.repeat(np.array(self.fixed)[:, None], parameters.shape[1], axis=1)
            full[np.isnan(self.fixed)] = named
            memory = np.zeros((3, parameters.shape[1]))
            memory[: self.begun] = begun
            r = simulate.m10(full, load, dt_s, memory)
        if not self.drifts:
            return r
        # Relative to the initial R0, of cells whose R0 changes linearly.
        return np.asarray((1 + r) * (1 + np.linspace(0, 1, len(r))[:, None] * parameters[len(named)]) - 1)

    def drifting(self) -> Kind:
        """The same kind with a drift of R0 as one more parameter, after the named ones."""
        return replace(
            self,
            names=(*self.names, "drift"),
            low=(*self.low, -DRIFTS),
            high=(*self.high, DRIFTS),
            starts=tuple((*start, 0.0) for start in self.starts),
            drifts=True,
        )


Richer = Callable[[tuple[float, ...]], tuple[float, ...]]
"""converts a solution to the parameters of the next, richer kind"""
FREE = np.nan


def asymmetric_kind(start: tuple[float, ...], size: float, begun: bool) -> Kind:
    g1, g2, g3, t2, t3 = start
    return Kind(
        kind="asymmetric",
        names=("gain1", "gain2", "fall2_s", "gain3", "fall3_s"),
        low=(1e-4 * size, 1e-4 * size, 0.2, 1e-4 * size, 3.0),
        high=(5 * size, 5 * size, 100.0, 5 * size, 3000.0),
        starts=((0.5 * size, 0.4 * size, 5.0, 0.1 * size, 100.0), (g1, g2, t2, g3, t3)),
        size=size,
        fixed=(FREE, 0.0, FREE, INSTANT_S, FREE, FREE, INSTANT_S, FREE, 0.0, INSTANT_S),
        begun=2 if begun else 0,
    )


def whole_kind(start: tuple[float, ...], size: float, begun: bool) -> Kind:
    """The kind m10 without chains that break (k = 0)."""
    g1, g2, g3, t2, t3 = start
    return Kind(
        kind="whole",
        names=M10_PARAMETERS[:-2],
        low=(-2 * size, -2 * size, 1e-4 * size, 0.02, 0.2, 1e-4 * size, 0.02, 3.0),
        high=(4 * size, 2 * size, 5 * size, 20.0, 100.0, 5 * size, 3000.0, 3000.0),
        starts=(
            (0.5 * size, 0.0, 0.3 * size, 0.4, 5.0, 0.2 * size, RISE2_S, 100.0),
            (g1, -0.05 * size, g2, 0.1, t2, g3, INSTANT_S, t3),
            (0.7 * size, 0.0, 0.2 * size, 3.0, 3.0, 0.2 * size, 60.0, 60.0),
        ),
        size=size,
        fixed=(*[FREE] * 8, 0.0, 30.0),
        begun=2 if begun else 0,
    )


def m10_kind(start: tuple[float, ...], size: float, begun: bool) -> Kind:
    whole = whole_kind(start, size, begun)
    _, graphical, slow = whole.starts
    return replace(
        whole,
        kind="m10",
        names=M10_PARAMETERS,
        low=(*whole.low, 1e-4 * size, 1.0),
        high=(*whole.high, 3 * size, 300.0),
        starts=(
            (0.35 * size, -0.6 * size, size, 0.4, 5.0, 0.2 * size, RISE2_S, 100.0, 0.2 * size, 30.0),
            (*graphical, 0.1 * size, 5.0),
            (*slow, 0.01 * size, 30.0),
        ),
        fixed=(FREE,) * 10,
        begun=3 if begun else 0,
    )


def paper_kind(start: tuple[float, ...], size: float) -> Kind:
    g1, g2, g3, t2, t3 = start
    return Kind(
        kind="paper",
        names=simulate.PAPER_PARAMETERS,
        low=(1e-4 * size, 1e-4 * size, 0.2, 1e-4 * size, 3.0, 1e-3, 0.1),
        high=(5 * size, 5 * size, 100.0, 5 * size, 3000.0, 3.0, 300.0),
        starts=((0.5 * size, 0.4 * size, 5.0, 0.1 * size, 100.0, 0.2, 5.0), (g1, g2, t2, g3, t3, 0.2, 5.0)),
        size=size,
    )


def asymmetric_as_whole(solution: tuple[float, ...]) -> tuple[float, ...]:
    """The same cell as parameters of "whole": no curvature, and both branches charge at once."""
    a, alpha1, fall1, alpha2, fall2, *recording = solution
    return a, 0.0, alpha1, INSTANT_S, fall1, alpha2, INSTANT_S, fall2, *recording


def whole_as_m10(solution: tuple[float, ...], size: float) -> tuple[float, ...]:
    """The same cell as parameters of "m10": hardly any chain breaks."""
    count = len(M10_PARAMETERS) - 2
    *branches, offset = solution[count:]
    return *solution[:count], 1e-3 * size, 30.0, *branches, *[0.0] * (len(branches) // 2), offset


def with_drift(solution: tuple[float, ...], count: int, share: float) -> tuple[float, ...]:
    """A solution with the drift ``share`` inserted after its ``count`` named parameters."""
    return *solution[:count], share, *solution[count:]


def model_of(kind: str, found: FloatArray, full_scale_kpa: float) -> Model:
    """The model section of CELL.toml; gains are divided by 1 + offset, since r refers to the corrected R0.

    Raises InputError if the parameters make no valid model.
    """
    unit = 1 + found[-1]
    try:
        if kind in ("m10", "whole"):
            count = len(M10_PARAMETERS) - (2 if kind == "whole" else 0)
            values = dict(zip(M10_PARAMETERS[:count], map(float, found), strict=False))
            values.setdefault("k", 0.0)
            for name in ("a", "b", "alpha1", "alpha2", "k"):
                values[name] /= unit
            return M10Model.model_validate(values)
        g1, g2, t2, g3, t3 = found[:5]
        (g2, t2), (g3, t3) = sorted(((g2, t2), (g3, t3)), key=lambda branch: branch[1])
        e1, e2, e3 = (float(full_scale_kpa * unit / gain) for gain in (g1, g2, g3))
        burgers = {"e1_kpa": e1, "e2_kpa": e2, "e3_kpa": e3, "eta2_kpa_s": e2 * float(t2), "eta3_kpa_s": e3 * float(t3)}
        if kind == "asymmetric":
            return AsymmetricModel.model_validate(burgers | {"rise_s": INSTANT_S})
        eu1 = 1 / (1 / e1 + 1 / e2 + 1 / e3)
        etau2 = eu1 / float(found[5])
        rising = {"eu1_kpa": eu1, "etau2_kpa": etau2, "eu2_kpa_per_s": etau2 / float(found[6])}
        return PaperModel.model_validate(burgers | rising)
    except ValidationError as error:
        raise InputError(f"no {kind} cell fits the recording: {error.errors()[0]['msg']}") from error
