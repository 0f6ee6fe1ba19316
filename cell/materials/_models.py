"""Parameters of the cell models (augmented Burgers, M10, contact): ``[model]`` of CELL.toml; equilibrium curves.

r = (R - R0)/R0 is the normalised resistance (P3), p the pressure in kPa, s = p / full scale the normalised load.
Moduli E and viscosities eta have no mechanical meaning here: they describe the normalised resistance (paper, IV.B).
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ...common.arrays import FloatArray
from ...common.config import Finite, NotNegative, Positive, Section


class Burgers(Section):
    """The augmented Burgers model, five elements (P5, equations 4 to 8)."""

    e1_kpa: Positive
    e2_kpa: Positive
    e3_kpa: Positive
    eta2_kpa_s: Positive
    """viscosity of the faster branch"""
    eta3_kpa_s: Positive
    """viscosity of the slower branch"""

    @property
    def t2_s(self) -> float:
        """Time constant of the faster branch (equation 9)."""
        return self.eta2_kpa_s / self.e2_kpa

    @property
    def t3_s(self) -> float:
        """Time constant of the slower branch (equation 9)."""
        return self.eta3_kpa_s / self.e3_kpa

    @property
    def gain_per_kpa(self) -> float:
        """The equilibrium gain, r per kPa: 1/E1 + 1/E2 + 1/E3."""
        return 1 / self.e1_kpa + 1 / self.e2_kpa + 1 / self.e3_kpa

    def transfer_function(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Numerator and denominator of G(s) = r/p as printed (equations 4 to 7), highest power first."""
        e1, e2, e3, n2, n3 = self.e1_kpa, self.e2_kpa, self.e3_kpa, self.eta2_kpa_s, self.eta3_kpa_s
        numerator = (n2 * n3 / e1, (e2 * n3 + e3 * n2) / e1 + n2 + n3, e2 * e3 / e1 + e2 + e3)
        return numerator, (n2 * n3, n2 * e3 + n3 * e2, e2 * e3)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.t2_s < self.t3_s:
            raise ValueError(
                f"the third branch must be the slower: eta2/E2 = {self.t2_s:g} s, eta3/E3 = {self.t3_s:g} s"
            )
        return self


class PaperModel(Burgers):
    """The paper's switched model: P4 while the load rises, P5 during recovery."""

    kind: Literal["paper"] = "paper"
    eu1_kpa: Positive
    eu2_kpa_per_s: Positive
    etau2_kpa: Positive

    rising_threshold_per_s: Positive | None = None
    """dr/dt above which the estimator switches to the rising model; None: as the recovery threshold"""
    recovery_threshold_per_s: Positive | None = None
    """-dr/dt above which the estimator switches to the recovery model; None: 1.2 times the settling slope at full
    scale"""
    derivative_s: NotNegative = 0.5
    """time over which the estimator computes dr/dt; 0: from one sample to the next"""

    @property
    def tu_s(self) -> float:
        """Settling time of a held load, etau2/Eu2."""
        return self.etau2_kpa / self.eu2_kpa_per_s

    @property
    def overshoot(self) -> float:
        """Instantaneous response of r to a pressure step, over the equilibrium response: 1 + Eu1/etau2 (P4)."""
        return 1 + self.eu1_kpa / self.etau2_kpa

    def settling_slope_per_s(self, pressure_kpa: float) -> float:
        """Steepest fall of r while ``pressure_kpa`` (p) is held after a step: p Eu2/etau2^2 (P8)."""
        return pressure_kpa * self.eu2_kpa_per_s / self.etau2_kpa**2

    def thresholds_per_s(self, full_scale_kpa: float) -> tuple[float, float]:
        """dr/dt above the first means rising, below the second (negative) recovery."""
        falling = self.recovery_threshold_per_s or 1.2 * self.settling_slope_per_s(full_scale_kpa)
        return self.rising_threshold_per_s or falling, -falling

    def rising_transfer_function(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Numerator and denominator of G_up = r/p (equation 3), highest power of s first.

        As printed, the second form of the equation has Eu1 as the constant of the numerator. The paper's own two terms
        add up to Eu2, which is used here.
        """
        return (self.eu1_kpa + self.etau2_kpa, self.eu2_kpa_per_s), (
            self.eu1_kpa * self.etau2_kpa,
            self.eu1_kpa * self.eu2_kpa_per_s,
        )

    @model_validator(mode="after")
    def _one_equilibrium(self) -> Self:
        rising = 1 / self.eu1_kpa
        if abs(rising - self.gain_per_kpa) > 0.01 * rising:
            raise ValueError(
                f"a held load must settle where recovery starts: 1/Eu1 = {rising:.6g} per kPa, but "
                f"1/E1 + 1/E2 + 1/E3 = {self.gain_per_kpa:.6g}; expected them equal within 1 %"
            )
        return self


class AsymmetricModel(Burgers):
    """One set of states for both phases: each branch charges with time constant ``rise_s``, and discharges as in P5.

    Loading then follows the gain of the rising phase, and unloading follows equation (8). Partial releases and repeated
    presses need no switch between models.
    """

    kind: Literal["asymmetric"] = "asymmetric"
    rise_s: Positive = 0.05


class M10Model(Section):
    """Asymmetric branches x1 and x2, a curved static response, and conductive chains that motion breaks (D)::

        r = a s + b s^2 + x1 + x2 + D
        xi' = (alphai s - xi)/T,    T = rise_i while alphai s > xi, else fall_i
        D'  = k |s'| - D/tau

    D is the contribution of broken chains, which heal with time constant tau.
    For b = 0, rise -> 0 and s' > 0 the model equals G_up of (3) with 1/Eu1 = (a + alpha1 + alpha2)/full scale,
    etau2 = full scale/k and Eu2 = full scale/(k tau). For k = 0 and discharging branches it equals G of (8).
    """

    kind: Literal["m10"] = "m10"
    a: Finite
    b: Finite = 0.0
    alpha1: NotNegative
    rise1_s: Positive
    fall1_s: Positive
    alpha2: NotNegative
    rise2_s: Positive = 0.05
    fall2_s: Positive
    k: NotNegative = 0.0
    tau_s: Positive = 30.0


class ContactModel(Section):
    """Electrodes that merely touch (P2): 1/R = 1/R0 + (p / full scale)^n / R_full. No memory."""

    kind: Literal["contact"] = "contact"
    exponent: Annotated[float, Field(gt=0, le=4)] = 1.0
    """n; 0.7 to 1.3 are published"""
    full_scale_resistance_ohm: Positive
    """resistance of the contact alone at full scale, R_full"""


Model = Annotated[PaperModel | AsymmetricModel | M10Model | ContactModel, Field(discriminator="kind")]


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
