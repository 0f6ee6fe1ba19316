"""CELL.toml: the parameters of one identified piezoresistive cell; makes its forward model and its estimators."""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from ..common.arrays import FloatArray, IntArray
from ..common.compiled import Records
from ..common.config import NotNegative, Positive, Section, load, write_toml
from ..errors import InputError
from .estimation import CONTACT, LOGARITHM, RATIO, Conditions, Estimator, Inversion, Scale, scale_of
from .inversions import (
    EquilibriumInversion,
    FollowedInversion,
    Learned,
    LearnedInversion,
    Numbers,
    Seen,
    StaticCurve,
    StaticCurveInversion,
    SwitchedInversion,
    rest_slope,
)
from .materials import (
    AsymmetricModel,
    ContactModel,
    Forward,
    M10Model,
    Model,
    PaperModel,
    equilibrium_curve,
    equilibrium_gain,
    make_forward,
    resistance_of,
    resistance_on_logarithm,
)

EstimatorName = Literal["static", "paper", "inverse", "distilled"]
ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)


OPEN = 50.0
"""resistance over that under full scale, from which a contact counts as open"""
REST_ERROR = 0.02
"""relative standard deviation of an R0 that the caller passes without stating its error; the project's own choice"""


class Calibrated(Section):
    """The result of ``ohmskin fit``: the estimators learned for this cell, and their cross-validation errors."""

    default: EstimatorName
    reason: str
    """why this estimator is the default"""
    held_out_percent: dict[EstimatorName, float]
    """rms error on what comes after the part that was learned from, % of full scale; empty without folds: not known"""
    fold_percent: dict[EstimatorName, Numbers] = Field(default_factory=dict)
    """the rms error on each fold after learning what comes right before it, % of full scale"""
    std_kpa: NotNegative = 0.0
    """standard deviation of the exact inverse by the error of the model, from the same errors; 0: not known"""
    seen: Seen = Seen()
    static: StaticCurve
    distilled: Learned | None = None


class Cell(Section):
    """A piezoresistive cell. ``Cell.load("cell.toml")``, or ``Cell.example()`` for the shipped one."""

    rest_resistance_ohm: Positive
    """R0, unloaded; a skin whose cells differ passes an array to :meth:`forward` and :meth:`estimator`"""
    full_scale_kpa: Positive
    """the largest pressure that the cell is meant for; normalised loads are multiples of it"""
    model: Model
    log_span: Positive | None = None
    """None: the model describes r = R/R0 - 1. A number: it describes r = ln(R0/R)/log_span, of a cell whose resistance
    falls under load and that remembers, as of Velostat"""
    estimators: Calibrated | None = None
    """None: the cell is not calibrated, and only estimators that follow from the model are available"""
    learned_from_model: ClassVar[Callable[[Cell], Calibrated]]
    """makes the estimators of an uncalibrated cell; given by the face of the room, as identification is above this"""

    @model_validator(mode="after")
    def _one_scale(self) -> Self:
        if self.log_span is not None and isinstance(self.model, ContactModel):
            raise ValueError("log_span is for models of cells that remember; a contact's resistance falls without it")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Cell:
        """Read CELL.toml. Raises InputError, whose message locates the fault, if the file is not a valid cell."""
        return load(path, cls)

    @classmethod
    def example(cls) -> Cell:
        """The shipped example: the paper's model with the project's own parameters, which meet property P7."""
        with importlib.resources.as_file(importlib.resources.files(__package__) / "example.toml") as path:
            return cls.load(path)

    def save(self, path: str | Path, *, comment: str = "") -> None:
        """Write CELL.toml atomically; ``comment`` goes to its head. Raises InputError."""
        write_toml(path, self.model_dump(exclude_none=True), comment=comment)

    @property
    def falls(self) -> bool:
        """Whether a load lowers the resistance."""
        full_r = equilibrium_gain(self.model, self.full_scale_kpa, self.rest_resistance_ohm)
        return self.log_span is not None or full_r < 0.0

    @property
    def open_at_rest(self) -> bool:
        """Whether a cell that reads no current bears no load, as of an FSR or Velostat; else it is not connected."""
        if isinstance(self.model, ContactModel):
            return self.rest_resistance_ohm >= OPEN * self.model.full_scale_resistance_ohm
        return self.log_span is not None

    def equilibrium_ohm(self, load: ArrayLike) -> FloatArray:
        """Resistance of the cell under shares of full scale ``load`` that are held for long."""
        rest = self.rest_resistance_ohm
        r = equilibrium_curve(self.model, self.full_scale_kpa, rest, np.asarray(load, dtype=np.float64))
        return rest * (1.0 + r) if self.log_span is None else resistance_on_logarithm(r, rest, self.log_span)

    @property
    def rest_slope_kpa(self) -> FloatArray:
        """(m,) pressure in kPa that a relative error of R0 looks like, at pressures spaced evenly up to full scale."""
        parallel = isinstance(self.model, ContactModel) and self.estimators is None
        return rest_slope(self.equilibrium_ohm, self.full_scale_kpa, parallel=parallel)

    @property
    def default_estimator(self) -> str:
        """The default estimator of this cell: the one that calibration chose, else the best that its model allows."""
        if self.estimators is not None:
            return self.estimators.default
        match self.model:
            case PaperModel():
                return "inverse"
            case ContactModel():
                return "static"
        return "distilled"

    def forward(self, shape: tuple[int, ...], *, rest_resistance_ohm: ArrayLike | None = None) -> Forward:
        """Cells of ``shape`` at rest, to be stepped through a pressure history.

        ``rest_resistance_ohm`` (broadcast to ``shape``) replaces R0, cell by cell; InputError unless it fits.
        """
        made = make_forward(self.model, self.full_scale_kpa, shape, self._rest(rest_resistance_ohm))
        made.log_span = self.log_span
        return made

    def estimator(
        self,
        shape: tuple[int, ...],
        name: str | None = None,
        *,
        rest_resistance_ohm: ArrayLike | None = None,
        noise: float | None = None,
        rest_error: float | None = None,
        beside: IntArray | None = None,
    ) -> Estimator:
        """A causal estimator for cells of ``shape``.

        Args:
            shape: of a frame.
            name: one of ``ESTIMATORS``; None: :attr:`default_estimator`.
            rest_resistance_ohm: R0, broadcast to ``shape``; None: the cell's.
            noise: first guess of the standard deviation of R/R0 at rest, until the noise has been measured. None: the
                noise of the calibration, if there is one. 0: readings are exact and are not smoothed.
            rest_error: relative standard deviation of R0, which widens the stated deviations. None: for a calibrated
                cell whose R0 is passed here, :data:`REST_ERROR`; else 0, since the held-out errors of a calibration
                include the error of its own R0.
            beside: (cells, most) cells beside each one of the flattened frame, filled up with their number. Their
                loads tell of a cell that is not read or whose contact seems to be bad. None: those of a rectangle if
                ``shape`` is rows and columns, else no cell tells of another one.

        Raises:
            InputError: no such estimator, or not one for this cell; R0 does not fit ``shape``, or ``shape`` has no
                cells; ``rest_error`` is not a number from 0 to 1, or ``noise`` is negative or not finite.
        """
        name = name or self.default_estimator
        if name not in ESTIMATORS:
            raise InputError(f"no estimator '{name}'; expected one of {', '.join(ESTIMATORS)}")
        learned = self.estimators
        if rest_error is None:
            rest_error = 0.0 if learned is None or rest_resistance_ohm is None else REST_ERROR
        if not 0 <= rest_error <= 1:
            raise InputError(f"the relative error of R0 is {rest_error}; expected a number from 0 to 1")
        if noise is not None and not 0 <= noise < np.inf:
            raise InputError(f"the noise of R/R0 is {noise}; expected a finite number, 0 or more")
        conditions = replace(self._conditions(name, noise), rest_error=rest_error)
        rest = resistance_of(shape, self._rest(rest_resistance_ohm)).ravel()
        if not rest.size:
            raise InputError(f"frames of shape {shape} have no cells; expected at least one")
        inversion = self._inversion(name, rest, exact=conditions.noise == 0.0)
        return Estimator(inversion, shape, rest, self._scale(rest), conditions, beside)

    def _scale(self, rest_resistance_ohm: FloatArray) -> Records[Scale]:
        """What turns readings of n cells with these rest resistances (n,) into r."""
        if isinstance(self.model, ContactModel):
            if self.estimators is None:
                unit = self._contact_ohm(rest_resistance_ohm)
                return scale_of(CONTACT, unit=unit, open_at_rest=self.open_at_rest)
            return scale_of(RATIO, open_at_rest=self.open_at_rest)
        if self.log_span is not None:
            return scale_of(LOGARITHM, unit=self.log_span)
        return scale_of(RATIO, falls=self.falls, open_at_rest=False)

    def _contact_ohm(self, rest_resistance_ohm: FloatArray) -> float:
        """The resistance at which the scale of contacts with these rest resistances (n,) begins."""
        assert isinstance(self.model, ContactModel)
        return min(float(np.median(rest_resistance_ohm)), OPEN * self.model.full_scale_resistance_ohm)

    def _inversion(self, name: str, rest_resistance_ohm: FloatArray, *, exact: bool) -> Inversion:
        """The inversion ``name`` for n cells with the resistances at rest ``rest_resistance_ohm`` (n,)."""
        model, full, learned = self.model, self.full_scale_kpa, self.estimators
        if learned is None and name == "distilled" and isinstance(model, AsymmetricModel | M10Model):
            learned = Cell.learned_from_model(self)
        full_r = equilibrium_gain(model, full, self.rest_resistance_ohm)
        match name:
            case "static":
                if learned is None:
                    rest = self.rest_resistance_ohm
                    if isinstance(model, ContactModel):
                        rest = self._contact_ohm(rest_resistance_ohm)
                    return EquilibriumInversion(model, full, rest, exact=exact)
                return StaticCurveInversion(learned.static, full, full_r, exact=exact)
            case "paper":
                if not isinstance(model, PaperModel):
                    raise self._other_kind(name, "paper")
                return SwitchedInversion(model, full)
            case "inverse":
                if not isinstance(model, PaperModel):
                    raise self._other_kind(name, "paper")
                return FollowedInversion(model, full, exact=exact)
            case "distilled":
                if learned is None or learned.distilled is None:
                    raise InputError(
                        f"the estimator '{name}' is learned from a recording, and this cell has none: run ohmskin fit"
                    )
                return LearnedInversion(learned.distilled, learned.static, full, full_r, exact=exact)
        raise InputError(f"the estimator '{name}' has no case in Cell._inversion")

    def _other_kind(self, name: str, kind: str) -> InputError:
        return InputError(f"the estimator '{name}' inverts a cell of kind '{kind}'; this one is '{self.model.kind}'")

    def _conditions(self, name: str, noise: float | None) -> Conditions:
        """The noise, speed of loads and model error found by calibration, for the estimator ``name``.

        Only inverses get a model error: they cannot see it in their readings.
        """
        learned, slope = self.estimators, self.rest_slope_kpa
        if learned is None:
            return Conditions(slope, noise=noise)
        return Conditions(
            slope,
            model_std_kpa=learned.std_kpa if name in ("paper", "inverse") else 0.0,
            noise=(learned.seen.noise or None) if noise is None else noise,
        )

    def _rest(self, given: ArrayLike | None) -> FloatArray:
        return np.asarray(self.rest_resistance_ohm if given is None else given, dtype=np.float64)
