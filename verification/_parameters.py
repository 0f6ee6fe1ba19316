"""Tolerances as independent factors: which boards can be built of a design, from its nominal one to its corners.

Every part value is linear in factors that each lie between -1 and 1::

    value = centre + matrix @ factors

A line that deviates on its own has one factor. Lines of one package share a factor and have a smaller one each
(``matching``). One factor stands for the ambient temperature, which the relative temperature coefficients follow. The
drift of an offset is that line's own: a data sheet gives its largest magnitude. A part that is tied to another one is
multiplied by the other's relative value. The corners of the cube of all factors are the worst cases; random points in
the cube are the samples of the Monte Carlo analysis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import erf, sqrt

import numpy as np
from scipy.special import erfinv

from ..circuits import Boards, Design, Spread
from ..common.arrays import FloatArray
from ._units import UNITS, engineering

IN_TIME = ("readout.gain_bandwidth", "readout.column_capacitance", "readout.feedback_capacitance")
"""Parts that settled readings do not depend on."""
CONVERTER = ("offset_voltage", "gain_error", "inl_steps")
"""Errors of the converter, in the order of the columns of :attr:`Population.converter`."""
MAXIMA = ("readout.offset_voltage", "readout.bias_current", *(f"adc.{name}" for name in CONVERTER))
"""A plain number here is a data-sheet maximum of either sign; a temperature coefficient has the part's unit per K."""
RATIOMETRIC = "adc.gain_error"
"""of a converter whose reference follows another part: its slope falls where the part rises"""
TEMPERATURE = "temperature"
NOMINAL_K = 298.15
_TRUNCATION = erf(3.0 / sqrt(2.0))  # share of a normal distribution within three standard deviations


@dataclass(frozen=True)
class Factor:
    """One independent deviation."""

    key: str
    """section and key of the part, or :data:`TEMPERATURE`"""
    line: int | None
    """row or column; None: all lines"""
    package: int | None = None
    """number of the package whose lines share the deviation"""
    distribution: str = "uniform"

    @property
    def name(self) -> str:
        """For a reader."""
        if self.package is not None:
            return f"{self.key}, package {self.package}"
        if self.line is None:
            return self.key
        return f"{self.key}[{self.line}]"


@dataclass(frozen=True)
class Population:
    """S boards, each with its converter's errors and the resistance of its cells relative to the nominal cell."""

    boards: Boards
    converter: FloatArray
    """(S, 3): V, relative slope, steps; see :data:`CONVERTER`"""


@dataclass(frozen=True)
class Factors:
    """All independent deviations of a design's parts."""

    factors: tuple[Factor, ...]
    centre: Mapping[str, FloatArray]
    """(L,) by part, of the boards that all factors 0 stand for"""
    matrix: Mapping[str, FloatArray]
    """(L, F) by part"""
    tied: Mapping[str, tuple[str, float]]
    """by part, the one that it follows, with the other's nominal value"""

    @classmethod
    def of(cls, design: Design, *, aged: bool = True) -> Factors:
        """The factors of a design whose spreads are not zero, at the end of the parts' lives or of new parts."""
        spreads = dict(design.spreads)
        nominal = _nominal_values(design)
        found: list[Factor] = []
        columns: list[tuple[str, FloatArray]] = []
        centre = {key: value.copy() for key, value in nominal.items()}
        drift: dict[str, FloatArray] = {}
        for key, value in nominal.items():
            spread = spreads.get(key)
            if spread is None:
                if key not in MAXIMA or not value.any():
                    continue
                centre[key] = np.zeros_like(value)
                for line, column in _own(np.abs(value), shared=_is_shared(design, key)):
                    found.append(Factor(key, line))
                    columns.append((key, column))
                continue
            low, high = (kelvin - NOMINAL_K for kelvin in design.operation.temperature_range or (NOMINAL_K, NOMINAL_K))
            drifts = abs(spread.temperature_coefficient) * max(abs(low), abs(high)) if key in MAXIMA else 0.0
            ageing = spread.ageing if aged else (0.0, 0.0)
            own = drifts + ageing[0] * np.abs(value) + ageing[1]
            for factor, column in _of_part(key, value, spread, own, shared=_is_shared(design, key)):
                found.append(factor)
                columns.append((key, column))
            if spread.temperature_coefficient and (low or high) and key not in MAXIMA and np.isfinite(value).all():
                slope = spread.temperature_coefficient * value
                centre[key] = centre[key] + slope * (low + high) / 2
                drift[key] = slope * (high - low) / 2
        matrix = {key: np.zeros((len(value), len(found) + bool(drift))) for key, value in nominal.items()}
        for number, (key, column) in enumerate(columns):
            matrix[key][:, number] = column
        if drift:
            found.append(Factor(TEMPERATURE, None))
            for key, column in drift.items():
                matrix[key][:, -1] = column
        tied = {}
        for key, spread in spreads.items():
            if spread.tied_to is not None and key in nominal:
                tied[key] = spread.tied_to, float(nominal[spread.tied_to][0])
        return cls(tuple(found), centre, matrix, tied)

    @classmethod
    def nominal(cls, design: Design) -> Factors:
        """No factors: only the board with the values that ``scan`` reads with."""
        values = _nominal_values(design)
        return cls((), values, {key: np.zeros((len(value), 0)) for key, value in values.items()}, {})

    @property
    def ends(self) -> tuple[str, ...]:
        """The parts of networks at the lines' ends."""
        sections = {*Boards.names().values(), "adc", "cells"}
        return tuple(key for key in self.centre if key.partition(".")[0] not in sections)

    def __len__(self) -> int:
        return len(self.factors)

    def values(self, key: str, factors: FloatArray) -> FloatArray:
        """(S, L) values of one part for factors (S, F)."""
        result: FloatArray = self.centre[key] + factors @ self.matrix[key].T
        if key not in self.tied:
            return result
        other, nominal = self.tied[key]
        follows = self.values(other, factors) / nominal
        return (1.0 + result) / follows - 1.0 if key == RATIOMETRIC else result * follows

    def population(self, factors: FloatArray) -> Population:
        """The boards of factors (S, F)."""
        parts = {}
        for name, section in Boards.names().items():
            values = self.values(f"{section}.{name}", factors)
            parts[name] = np.maximum(values, 1.0) if name == "open_loop_gain" else values
        ends = {key: self.values(key, factors) for key in self.ends}
        if "adc.gain_error" in self.centre:
            converter = np.concatenate([self.values(f"adc.{name}", factors) for name in CONVERTER], axis=1)
        else:
            converter = np.zeros((len(factors), len(CONVERTER)))
        return Population(Boards(**parts, ends=ends), converter)

    def sample(self, random: np.random.Generator, count: int) -> FloatArray:
        """(S, F) random factors."""
        uniform = random.uniform(-1.0, 1.0, (count, len(self)))
        drawn = uniform.copy()
        for number, factor in enumerate(self.factors):
            column = uniform[:, number]
            if factor.distribution == "normal":
                drawn[:, number] = sqrt(2.0) * erfinv(column * _TRUNCATION) / 3.0
            elif factor.distribution == "two-point":
                drawn[:, number] = np.where(column < 0, -1.0, 1.0)
        return drawn

    def describe(self, factors: FloatArray) -> str:
        """A corner in words: parts, and the sign of each line."""
        signs: dict[str, list[tuple[str, int]]] = {}
        packaged = {factor.key for factor in self.factors if factor.package is not None}
        for factor, value in zip(self.factors, factors, strict=True):
            if value == 0:
                continue
            place = "" if factor.line is None else str(factor.line)
            if factor.package is not None:
                place = f"package {factor.package}"
            elif factor.key in packaged:
                place = f"line {place}"
            signs.setdefault(factor.key, []).append((place, 1 if value > 0 else -1))
        words = (f"{key} {_signs(lines)}{self._negative(key, factors)}" for key, lines in signs.items())
        return "; ".join(words) or "nominal parts"

    def varied(self, factors: FloatArray) -> dict[str, FloatArray]:
        """(L,) values of every kind of part that has a spread, for factors (F,)."""
        found = {}
        for key, matrix in self.matrix.items():
            if matrix.any() or key in self.tied:
                values = self.values(key, factors[None])[0]
                found[key] = np.maximum(values, 1.0) if key == "readout.open_loop_gain" else values
        return found

    def _negative(self, key: str, factors: FloatArray) -> str:
        """The value of a negative part, whose "high" is its smaller magnitude; empty for others."""
        if key not in self.centre or len(self.centre[key]) > 1 or self.centre[key][0] >= 0:
            return ""
        section, _, name = key.partition(".")
        value = float(self.values(key, factors[None])[0, 0])
        return f" ({engineering(value, UNITS.get(section, {}).get(name, ''))})"


def _signs(lines: list[tuple[str, int]]) -> str:
    up, down = ([label for label, sign in lines if sign == wanted] for wanted in (1, -1))
    if not down:
        return "high"
    if not up:
        return "low"
    few, word = (up, "high") if len(up) <= len(down) else (down, "low")
    other = "low" if word == "high" else "high"
    return f"{word} at {', '.join(few)}, {other} elsewhere"


def _is_shared(design: Design, key: str) -> bool:
    """Whether all lines have one and the same part: that of a multiplexed readout."""
    return design.board.multiplexed and key.startswith("readout.")


def _of_part(
    key: str, value: FloatArray, spread: Spread, own: FloatArray, *, shared: bool
) -> Iterator[tuple[Factor, FloatArray]]:
    """The factors of one kind of part, each with its column of the matrix (L,); ``own`` (L,) is each line alone."""
    count = len(value)
    width = spread.tolerance * np.abs(value) + spread.deviation + own
    if spread.matching is not None:
        size = spread.package or count
        common = (spread.tolerance - spread.matching) * np.abs(value)
        width = spread.matching * np.abs(value) + spread.deviation + own
        for package in range(-(-count // size)):
            members = np.arange(count) // size == package
            if common[members].any():
                yield Factor(key, None, package, spread.distribution), np.where(members, common, 0.0)
    for line, column in _own(width, shared=shared):
        yield Factor(key, line, None, spread.distribution), column


def _own(width: FloatArray, *, shared: bool) -> Iterator[tuple[int | None, FloatArray]]:
    """Each line with its column of the matrix (L,) for deviations of its own of at most ``width`` (L,)."""
    if shared and width[0] > 0 and np.isfinite(width[0]):
        yield None, width
    for line in range(0 if shared else len(width)):
        if width[line] > 0 and np.isfinite(width[line]):
            yield line if len(width) > 1 else None, np.where(np.arange(len(width)) == line, width[line], 0.0)


def _nominal_values(design: Design) -> dict[str, FloatArray]:
    boards = Boards.of(design)
    values = {f"{section}.{name}": getattr(boards, name)[0] for name, section in Boards.names().items()}
    values |= design.end_parts
    if design.adc is not None:
        values |= {f"adc.{name}": np.array([getattr(design.adc, name)]) for name in CONVERTER}
    return values
