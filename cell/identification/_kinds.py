"""The kinds of cell as separable models: responses to unit gains, and what gains and time constants make of a model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import ValidationError

from ...common.arrays import FloatArray
from ...errors import InputError
from ..inversions import play_follow
from ..materials import M10_PARAMETERS, M10Model, Model, PaperModel, simulate
from ._projection import Group, Kind, Solution

FLATTEST = 0.1
"""least slope dr/ds of the equilibrium curve at all loads s, over the range of r: the inverse needs a rising curve"""
LEAST_GAIN = 1e-4
"""least gain of a branch of the paper's model, over the range of r"""


def _m10(columns: Mapping[str, FloatArray | float], load: FloatArray, dt_s: float) -> FloatArray:
    """r (n, m) of kind m10 with these parameters, others 0 or of no effect."""
    count = max(np.size(value) for value in columns.values())
    values = np.ones((len(M10_PARAMETERS), count))
    for place, name in enumerate(M10_PARAMETERS):
        values[place] = columns.get(name, 1.0 if name.endswith("_s") else 0.0)
    return simulate.m10(values, load[:, None], dt_s)


def _equilibrium(times_s: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Responses to the slopes of the equilibrium curve at no load and at full scale, between which it is straight."""
    pair = np.stack([load - load**2 / 2, load**2 / 2], axis=1)
    return np.repeat(pair[:, None, :], max(times_s.shape[1], 1), axis=1)


def _branch(times_s: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Response of a branch, less its equilibrium."""
    return np.asarray(
        (_m10({"alpha1": 1.0, "rise1_s": times_s[0], "fall1_s": times_s[1]}, load, dt_s) - load[:, None])[..., None]
    )


def _chains(times_s: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Response of conductive chains that motion breaks."""
    return _m10({"k": 1.0, "tau_s": times_s[0]}, load, dt_s)[..., None]


M10 = Kind(
    name="m10",
    gains=("rest_slope", "full_slope", "alpha1", "alpha2", "k"),
    least=(FLATTEST, FLATTEST, 0.0, 0.0, 0.0),
    fixed=_equilibrium,
    groups=(
        Group(("rise1_s", "fall1_s"), ((0.03, 0.3, 2.0), (0.4, 1.5, 5.0, 20.0)), _branch),
        Group(("rise2_s", "fall2_s"), ((0.05, 1.0, 15.0, 100.0), (10.0, 60.0, 300.0)), _branch),
        Group(("tau_s",), ((2.0, 10.0, 50.0),), _chains),
    ),
    usual_s=(0.4, 5.0, 1.0, 100.0, 30.0),
    low_s=(0.02, 0.2, 0.02, 3.0, 1.0),
    high_s=(20.0, 100.0, 3000.0, 3000.0, 300.0),
)


def _paper(times_s: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Responses to the gains of the three branches and to that of the overshoot.

    The model is linear in them, but simulated with all of them above 0: each response is a difference from that to 1.
    """
    fall2, fall3, settle = times_s
    responses = []
    for more in (None, 0, 1, 2, 3):
        gains = np.ones((4, times_s.shape[1]))
        if more is not None:
            gains[more] += 1.0
        overshoot = gains[3] / gains[:3].sum(axis=0)
        parameters = np.stack([gains[0], gains[1], fall2, gains[2], fall3, overshoot, settle])
        responses.append(simulate.paper(parameters, load[:, None], dt_s))
    return np.stack([one - responses[0] for one in responses[1:]], axis=2)


def _nothing(times_s: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    return np.zeros((len(load), max(times_s.shape[1], 1), 0))


def _without_noise(load: FloatArray) -> FloatArray:
    """The load behind a play: noise would switch the phase of the paper's model."""
    return play_follow(load[:, None], 4 * simulate.white_noise(load))[:, 0]


PAPER = Kind(
    name="paper",
    gains=("gain1", "gain2", "gain3", "overshoot"),
    least=(LEAST_GAIN,) * 4,
    fixed=_nothing,
    groups=(
        Group(
            ("fall2_s", "fall3_s", "settle_s"),
            ((0.5, 2.0, 8.0, 30.0), (10.0, 40.0, 150.0, 600.0), (0.3, 1.5, 6.0, 25.0)),
            _paper,
        ),
    ),
    usual_s=(5.0, 100.0, 5.0),
    low_s=(0.2, 3.0, 0.1),
    high_s=(100.0, 3000.0, 300.0),
    felt=_without_noise,
)


def parameters(solution: Solution) -> dict[str, float]:
    """Parameters of the model's simulation by name, for r over the R0 of the recording: of m10, or of the paper's."""
    times = dict(zip(solution.kind.times, map(float, solution.times_s), strict=True))
    gains = dict(zip(solution.kind.gains, map(float, solution.gains), strict=True))
    if solution.kind is M10:
        rest, full = gains.pop("rest_slope"), gains.pop("full_slope")
        return {"a": rest - gains["alpha1"] - gains["alpha2"], "b": (full - rest) / 2} | gains | times
    gains["overshoot"] /= gains["gain1"] + gains["gain2"] + gains["gain3"]
    return gains | times


def model_of(solution: Solution, full_scale_kpa: float) -> Model:
    """The model section of CELL.toml; gains are divided by 1 + offset, since r refers to the corrected R0.

    Raises InputError if the parameters make no valid model.
    """
    unit, found = 1.0 + solution.offset, parameters(solution)
    try:
        if solution.kind is M10:
            scaled = {name: found[name] / unit for name in ("a", "b", "alpha1", "alpha2", "k")}
            return M10Model.model_validate(found | scaled)
        branches = sorted((found[f"fall{n}_s"], found[f"gain{n}"]) for n in (2, 3))
        (t2, g2), (t3, g3) = branches
        e1, e2, e3 = (full_scale_kpa * unit / gain for gain in (found["gain1"], g2, g3))
        eu1 = 1 / (1 / e1 + 1 / e2 + 1 / e3)
        etau2 = eu1 / found["overshoot"]
        return PaperModel(
            e1_kpa=e1,
            e2_kpa=e2,
            e3_kpa=e3,
            eta2_kpa_s=e2 * t2,
            eta3_kpa_s=e3 * t3,
            eu1_kpa=eu1,
            etau2_kpa=etau2,
            eu2_kpa_per_s=etau2 / found["settle_s"],
        )
    except ValidationError as error:
        raise InputError(f"no {solution.kind.name} cell fits the recording: {error.errors()[0]['msg']}") from error


def simulated(
    solution: Solution, rest_ohm: float, rng: np.random.Generator, load: FloatArray, dt_s: float
) -> FloatArray:
    """Resistance (n, m) of cells like the identified one, with random deviations of 6 % in gains, 12 % in times."""
    found = parameters(solution)
    cells = load.shape[1]
    jittered = {}
    for name, value in found.items():
        noise = rng.standard_normal(cells)
        jittered[name] = value * (np.exp(0.12 * noise) if name.endswith("_s") else 1 + 0.06 * noise)
    if solution.kind is M10:
        r = simulate.m10(np.stack([jittered[name] for name in M10_PARAMETERS]), load, dt_s)
    else:
        felt = play_follow(load, 4 * simulate.white_noise(load[:, 0]))
        r = simulate.paper(np.stack([jittered[name] for name in simulate.PAPER_PARAMETERS]), felt, dt_s)
    return np.asarray(rest_ohm * (1 + solution.offset + r))
