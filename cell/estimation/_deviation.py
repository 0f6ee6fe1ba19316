"""Uncertainty propagation: standard deviation of the estimated pressures as a sum of variances; shrinkage towards 0.

The variance of a followed cell sums several parts: noise, changes that the smoothing may not have noticed yet, the
inversion's memory, motion within the frame, the model, R0, and the parts that :mod:`._following` adds (bad contacts,
motion within the noise). A sleeping cell may carry any load that its reading does not exclude.
Small pressures that noise alone could cause are shown closer to 0.

Programs that do not read the deviation of a frame should not pay for it. Each frame therefore stores the inputs of its
variances (:class:`LeftOpen`), in arrays that never change again. The sum is evaluated when it is asked for, or when
other cells are to be followed. Compiled loops evaluate it at once, which costs them less than copying the inputs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray, IntArray
from . import _loops as loops
from ._conditions import Conditions
from ._inversion import DOUBT, DOUBTED_LOAD, LIGHT_LOAD, NO_LOAD_SIGMAS, USUAL, Inversion
from ._loops import ASLEEP_SIGMAS
from ._noise import NoiseMeter
from ._remembered import Block, Remembered
from ._rows import GAIN, PRESSURE, SHARED, VARIANCE
from ._sleep import AT_REST, Sleep
from ._smoothing import HIDDEN, SIGMAS, Looked

TINY = 1e-30
"""avoids 0/0"""
MODEL_ERROR = 0.005
"""fraction of full scale: the least standard deviation without a calibration. It covers loads that an estimator
neglects: loads so small that a cell sleeps under them, and turning points below a percent. It does not estimate the
error of a model, which only a comparison with a recording can"""

_ZERO, _TINY = np.array(0.0), np.array(TINY)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class LeftOpen(NamedTuple):
    """Inputs of the variances of one frame. Arrays never change again."""

    cells: IntArray
    """(m,) cells that were followed"""
    memory: FloatArray
    """(SHARED, m) first rows of their memory after the frame"""
    looked: Looked | None
    """None: readings are exact"""
    added: FloatArray | None
    """(m,) kPa^2 in addition to the variances by noise and memory"""


class Asleep(NamedTuple):
    """Inputs of the variances of sleeping cells. Arrays never change again."""

    cells: IntArray
    """(m,)"""
    per_reading: FloatArray
    """(m,) standard deviation in kPa per r: the reading may be due to a load, although 0 is shown"""
    hidden_kpa: FloatArray
    """(m,) standard deviation in kPa of a further load that the noise may hide"""

    def without(self, cells: IntArray, of: int) -> Asleep | None:
        """The same without ``cells`` (k,), in an array of ``of`` cells; None: no cell remains."""
        kept = np.ones(of, dtype=np.bool_)
        kept[cells] = False
        places = kept[self.cells].nonzero()[0]
        if not places.size:
            return None
        return Asleep(self.cells.take(places), self.per_reading.take(places), self.hidden_kpa.take(places))

    def add_to(self, variance: FloatArray, reading: FloatArray, *, compiled: bool) -> None:
        """Add the variance of loads that the present readings (n,) do not exclude, to variances (n,) in kPa^2."""
        if compiled:
            loops.add_asleep.unchecked(variance, reading, self.cells, self.per_reading, self.hidden_kpa)
            return
        std = np.abs(reading.take(self.cells))
        std *= self.per_reading
        std += self.hidden_kpa
        std *= std
        variance[self.cells] += std


class Deviation:
    """The variances of n cells in kPa^2, and their inputs. Gaps and creep are added when the variances are read."""

    def __init__(self, inversion: Inversion, conditions: Conditions, cells: int) -> None:
        self._inversion, self._full_kpa = inversion, inversion.full_scale_kpa
        self.stated = inversion.knows_errors or conditions.model_std_kpa > 0
        """whether a standard deviation is stated; else all are NaN"""
        self._model_variance = np.array((conditions.model_std_kpa or MODEL_ERROR * self._full_kpa) ** 2)
        rest_std_kpa = np.zeros(0) if conditions.rest_std_kpa is None else conditions.rest_std_kpa
        self._rest_variance = rest_std_kpa**2
        self._rest_at_kpa = np.linspace(0, self._full_kpa, rest_std_kpa.size)
        self._doubt_kpa2 = (DOUBT * self._full_kpa) ** 2
        self._variance = np.full(cells, np.nan)
        """(n,) kPa^2 without gaps; out of date for the cells of ``_left_open``; replaced, never changed"""
        self._left_open: LeftOpen | None = None
        self._asleep: Asleep | None = None
        self._numbers = self._numbers_of_loops()
        self.compiled = False
        """whether compiled loops are in use"""

    def _numbers_of_loops(self) -> FloatArray:
        """The parameter array of :func:`._loops.show`."""
        full = self._full_kpa
        within, sure = self._inversion.bends
        numbers = {
            loops.MODEL_VARIANCE: float(self._model_variance),
            loops.WITHIN: within,
            loops.SURE: sure,
            loops.FULL: full,
            loops.MUCH: USUAL * full,
            loops.MUCH_NOISE: AT_REST * full,
            loops.NO_LOAD: NO_LOAD_SIGMAS,
            loops.TINY: TINY,
            loops.HIDDEN: HIDDEN,
            loops.PER_SIGMAS: 1.0 / SIGMAS,
            loops.STATED: float(self.stated),
            loops.SIGMAS: SIGMAS,
            loops.HIDDEN_SHARE: HIDDEN / SIGMAS,
            loops.RISE_KPA: float(self._inversion.steepness_kpa[0]),
            loops.FALL_KPA: float(self._inversion.steepness_kpa[1]),
            loops.RESTS: self._inversion.rests,
            loops.DOUBT_KPA2: self._doubt_kpa2,
            loops.LIGHT_KPA2: (LIGHT_LOAD * full) ** 2,
            loops.DOUBTED_KPA2: (DOUBTED_LOAD * full) ** 2,
        }
        return np.array([numbers[place] for place in range(len(numbers))])

    # -- cells that are followed -------------------------------------------------------------------------------------

    def follow(self, cells: IntArray) -> None:
        """Note that ``cells`` (m,) are followed, and no longer sleep."""
        if self._asleep is not None:
            self._asleep = self._asleep.without(cells, self._variance.size)

    def take_exact(self, block: Block) -> None:
        """Take the memory of a frame whose readings are exact."""
        self._left_open = LeftOpen(block.cells, block.memory[:SHARED].copy(), None, None)

    def show(self, block: Block, looked: Looked, added: FloatArray | None) -> FloatArray:
        """Take a frame; ``added`` (m,) are variances in kPa^2 by effects outside the inversion, None: zero.

        Returns:
            (m,) pressures to show in kPa.
        """
        memory = block.memory
        pressure: FloatArray = memory[PRESSURE]
        usual = USUAL * self._full_kpa
        if pressure.item(pressure.argmax()) > usual:
            # A pressure beyond full scale may just as well be an error of the memory.
            excess = np.maximum(pressure - self._full_kpa, 0.0)
            by_noise = looked.doubt_kpa(memory[GAIN], self._inversion.steepness_kpa)
            doubtful = total(added, memory[VARIANCE]) + by_noise**2 > self._doubt_kpa2
            pressure = np.where(doubtful, np.minimum(pressure, usual), pressure)
            added = total(added, excess**2)
        noise_kpa = looked.std * memory[GAIN]
        much_noise = noise_kpa.item(noise_kpa.argmax()) > AT_REST * self._full_kpa
        released = self._inversion.released(memory)
        if much_noise or released is not None:
            likely = _likely(pressure, self._inversion.hides_kpa2(memory, noise_kpa))
            if released is not None and not much_noise:
                np.copyto(likely, pressure, where=~released)
            hidden = pressure - likely
            hidden *= hidden
            added = total(added, hidden)
            pressure = likely
        self._left_open = LeftOpen(block.cells, memory[:SHARED].copy(), looked, added)
        return pressure

    def show_compiled(self, block: Block, added: FloatArray, pressure: FloatArray) -> None:
        """:meth:`show` by compiled loops, which write into ``pressure`` (n,) of all cells."""
        variance = self._variance.copy()
        loops.show.unchecked(
            *(block.memory, block.line, block.taken, added, self._numbers, self._rest_at_kpa, self._rest_variance),
            *(block.cells, pressure, variance),
        )
        self._variance, self._left_open = variance, None

    def flush(self) -> None:
        """Store the variances of the last frame, since other cells are to be followed."""
        if self._left_open is not None:
            self._variance = self._variance.copy()
            self._variance[self._left_open.cells] = self._variance_of(self._left_open)
            self._left_open = None

    # -- cells that sleep --------------------------------------------------------------------------------------------

    def watch_over(self, asleep: IntArray, remembered: Remembered, sleep: Sleep, noise: NoiseMeter) -> None:
        """Update the variances of the cells ``asleep`` (m,), and their wake-up thresholds, to the present noise."""
        self._variance = self._variance.copy()
        if self.compiled:
            per_reading, hidden_kpa = np.empty((2, asleep.size))
            loops.watch_over.unchecked(
                *(asleep, remembered.memory, sleep.mean, noise.at_rest, sleep.band, self._numbers),
                *(self._rest_at_kpa, self._rest_variance, sleep.wake_at, per_reading, hidden_kpa, self._variance),
            )
            self._asleep = Asleep(asleep, per_reading, hidden_kpa)
            return
        memory = remembered.memory[:, asleep]
        std = noise.std(sleep.mean[asleep], asleep)
        sleep.wake_at[asleep] = ASLEEP_SIGMAS * std + sleep.band
        self._variance[asleep] = self._own_variance(memory, np.zeros(asleep.size)) + memory[PRESSURE] ** 2
        self._asleep = Asleep(asleep, memory[GAIN] / SIGMAS, memory[GAIN] * (HIDDEN / SIGMAS) * std)

    # -- what is stated ----------------------------------------------------------------------------------------------

    def of_last_step(
        self, shape: tuple[int, ...], reading: FloatArray, *more: FloatArray | None
    ) -> Callable[[], FloatArray]:
        """A function that returns the variances (shape) in kPa^2 of the last frame, at any time and in any thread.

        Args:
            shape: shape of a frame.
            reading: (n,) r of the frame; never changes again.
            more: (n,) further variances in kPa^2, which never change again; None: zero.
        """
        return partial(self._after, shape, self._variance, self._asleep, reading, self._left_open, more)

    def _after(
        self,
        shape: tuple[int, ...],
        before: FloatArray,
        asleep: Asleep | None,
        reading: FloatArray,
        left_open: LeftOpen | None,
        added: tuple[FloatArray | None, ...],
    ) -> FloatArray:
        """(shape) kPa^2: variances ``before`` the step, updated by sleeping and followed cells, plus ``added`` ones."""
        if left_open is not None and left_open.cells.size == before.size:
            variance = self._variance_of(left_open)
        else:
            variance = before.copy()
            if asleep is not None:
                asleep.add_to(variance, reading, compiled=self.compiled)
            if left_open is not None:
                variance[left_open.cells] = self._variance_of(left_open)
        for more in added:
            if more is not None:
                variance += more
        return variance.reshape(shape)

    def _variance_of(self, left_open: LeftOpen) -> FloatArray:
        """(m,) variance in kPa^2 of the cells that were followed in a frame."""
        looked, memory = left_open.looked, left_open.memory
        if looked is None:
            std_kpa = np.zeros(left_open.cells.size)
        else:
            std_kpa = looked.doubt_kpa(memory[GAIN], self._inversion.steepness_kpa)
        variance = self._own_variance(memory, std_kpa)
        if left_open.added is not None:
            variance += left_open.added
        return variance

    def _own_variance(self, memory: FloatArray, std_kpa: FloatArray) -> FloatArray:
        """(m,) variance in kPa^2 of cells whose readings leave a standard deviation ``std_kpa`` (m,) of pressure."""
        if not self.stated:
            return np.full(memory.shape[1], np.nan)
        variance: FloatArray = std_kpa * std_kpa
        variance += self._inversion.within_frame(memory, np.sqrt(variance))
        variance += memory[VARIANCE]
        variance += self._model_variance
        if self._rest_variance.size:
            variance += np.interp(memory[PRESSURE], self._rest_at_kpa, self._rest_variance)
        return variance

    def state(self) -> dict[str, FloatArray]:
        """The state, by name. To be called after :meth:`flush`."""
        return {"variance": self._variance}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._variance, self._left_open, self._asleep = state["variance"], None, None


def total(one: FloatArray | None, other: FloatArray) -> FloatArray:
    """The sum of variances (m,), of which the first may be None."""
    return other if one is None else one + other


def _likely(pressure: FloatArray, hides_kpa2: FloatArray) -> FloatArray:
    """(m,) pressures p, shrunk to p / (1 + (h / p^2)^2) with h = ``hides_kpa2`` (m,), as noise alone may be the cause.

    Most cells carry no load. Where p^2 < h, no load is more likely than a load. The memory of the cells is unchanged.
    """
    squared = pressure * pressure
    squared *= squared
    either: FloatArray = hides_kpa2 * hides_kpa2
    either += squared
    either += _TINY
    squared /= either
    squared *= pressure
    return squared
