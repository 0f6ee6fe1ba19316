"""Static characteristic of a cell: the equilibrium resistance under a pressure that is held for long."""

from __future__ import annotations

from ...common.arrays import FloatArray
from ._models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel


def equilibrium_gain(model: Model, full_scale_kpa: float, rest_resistance_ohm: float) -> float:
    """r at equilibrium under full scale; negative for a contact."""
    match model:
        case PaperModel() | AsymmetricModel():
            return model.gain_per_kpa * full_scale_kpa
        case M10Model():
            return model.a + model.b + model.alpha1 + model.alpha2
        case ContactModel():
            return 1 / (1 + rest_resistance_ohm / model.full_scale_resistance_ohm) - 1


def equilibrium_curve(model: Model, full_scale_kpa: float, rest_resistance_ohm: float, load: FloatArray) -> FloatArray:
    """r at equilibrium under each normalised ``load``; equals :func:`equilibrium_gain` at ``load`` = 1."""
    match model:
        case PaperModel() | AsymmetricModel():
            curve = model.gain_per_kpa * full_scale_kpa * load
        case M10Model():
            curve = (model.a + model.alpha1 + model.alpha2) * load + model.b * load**2
        case ContactModel():
            curve = 1 / (1 + rest_resistance_ohm / model.full_scale_resistance_ohm * load**model.exponent) - 1
    return curve
