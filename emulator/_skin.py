"""A scene's physics, tick by tick: contacts to pressure to cells to volts to counts. No clock and no I/O."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..circuits import adc_codes, scan
from ._scene import Scene
from ._spread import spread


@dataclass(frozen=True, slots=True)
class Sample:
    """Everything about one frame, known only to the emulator. Arrays are (rows, columns)."""

    sequence: int
    time_s: float
    """since the board started"""
    pressure_kpa: FloatArray
    """on the surface above each cell"""
    resistance_ohm: FloatArray
    """of the cells themselves"""
    volts: FloatArray
    """at the ADC, noise included"""
    counts: CodeArray


class EmulatedSkin:
    """The skin of a scene, at rest until its first tick."""

    def __init__(self, scene: Scene, noise: np.random.Generator) -> None:
        self._scene = scene
        self._noise = noise
        self._cells = scene.skin.cell.forward(scene.skin.design.array.shape)
        self._time_s: float | None = None
        self._pressure = np.zeros(scene.skin.design.array.shape)
        self._resistance = self._cells.step(0.0, self._pressure)

    def advance(self, time_s: float) -> None:
        """Let the scene go on to ``time_s``; the pressure is taken to change linearly since the last call."""
        elapsed = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = time_s
        self._pressure = self._scene.pressure_kpa(time_s)
        felt = spread(self._pressure, self._scene.skin.spreading_pitches)
        self._resistance = self._cells.step(elapsed, felt)

    def scan(self, sequence: int) -> Sample:
        """Read the whole array as it is now."""
        assert self._time_s is not None, "advance() first"
        design = self._scene.skin.design
        volts = scan(design, self._resistance).volts
        if self._scene.board.noise:
            volts = volts + self._noise.normal(scale=self._scene.board.noise, size=volts.shape)
        return Sample(sequence, self._time_s, self._pressure, self._resistance, volts, adc_codes(design, volts))
