"""What a scene costs and what it leaves out, before it is run: ``ohmskin emulate SCENE --plan``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from time import process_time

import numpy as np

from ..circuits import Effect, effects, ideal_volts
from ._board import Board
from ._scene import Scene
from ._skin import FrameBlock

_LONGEST_S = 60.0
"""s of the scene that are tried at most"""

_NOT_MODELLED = (
    "time within a frame: all cells are read at the same instant",
    "settling of the amplifiers and lines (ohmskin.circuits.Settling)",
    "slip, large deformation and cuts in the layer above the cells",
)


@dataclass(frozen=True)
class PlannedEffect:
    """One effect of the circuit, and its size on this scene."""

    name: str
    modelled: bool
    steps: float | None
    """ADC steps, to first order, at most: the largest relative change of a cell's signal times the largest signal; None
    where there is no simple law"""
    basis: str
    """the part that the size is for"""


@dataclass(frozen=True)
class Plan:
    """What would be emulated, how, and how fast. From the first seconds of the scene, tried out."""

    array: tuple[int, int]
    frame_rate_hz: float
    tried_s: float
    """s of the scene"""
    frames: int
    """tried"""
    most_cells: int
    """most cells that were not at rest at the same time"""
    methods: dict[str, int]
    """frames by the method that read the circuit"""
    error_steps: float
    """largest certified error of a reading, in ADC steps, before noise and rounding to a code"""
    frames_per_second: float
    """from contacts to encoded packets, per second of processor time"""
    effects: tuple[PlannedEffect, ...]

    def lines(self) -> list[str]:
        """The plan as text for a terminal."""
        rows, columns = self.array
        solved = ", ".join(f"{count} by {method}" for method, count in sorted(self.methods.items()))
        text = [
            f"{rows} x {columns} cells, {self.frame_rate_hz:g} frames/s, tried for {self.tried_s:.3g} s of the scene",
            f"cells: at most {self.most_cells} of {rows * columns} are stepped; the others are at rest",
            f"circuit: {self.frames} frames read, {solved}",
            f"certified error: at most {self.error_steps:.2g} ADC steps, before noise and rounding to a code",
            f"speed: about {self._speed()}",
            "",
            f"{'effect':<18} {'modelled':<9} {'steps <=':>9}  basis",
        ]
        for effect in self.effects:
            steps = "-" if effect.steps is None else f"{effect.steps:.2g}"
            text.append(f"{effect.name:<18} {'yes' if effect.modelled else 'no':<9} {steps:>9}  {effect.basis}")
        return [*text, "", "not modelled at all:", *(f"  {line}" for line in _NOT_MODELLED)]

    def _speed(self) -> str:
        times = self.frames_per_second / self.frame_rate_hz
        verdict = "in time" if times > 1.0 else "too slow for the real clock"
        return f"{self.frames_per_second:.2g} frames per processor second, {times:.2g} times the frame rate: {verdict}"


def plan(scene: Scene, *, seed: int = 0, budget_s: float = 1.0) -> Plan:
    """Try the beginning of a scene and say what it takes.

    Args:
        scene: what would be emulated.
        seed: of the noise.
        budget_s: s of processor time that trying may take.

    Raises:
        SolverError: the scene leads to a circuit without a solution.

    """
    adc = scene.skin.design.adc
    assert adc is not None  # a scene is refused without one
    board = Board(scene, seed=seed)
    board.prepare()
    methods: Counter[str] = Counter()
    block = busiest = None
    frames, error_volts = 0, 0.0
    start = process_time()
    while process_time() < start + budget_s and board.next_us <= 1e6 * _LONGEST_S:
        board.tick()
        frames += 1
        if board.skin.block is not block:
            block = board.skin.block
            assert block is not None
            methods.update(block.method)
            error_volts = max(error_volts, float(block.error_volts.max()))
            if busiest is None or block.cells_stepped > busiest.cells_stepped:
                busiest = block
    spent_s = process_time() - start
    assert busiest is not None
    # The last block is computed whole, and counts only with the frames that were sent.
    return Plan(
        array=scene.skin.design.array.shape,
        frame_rate_hz=scene.board.frame_rate,
        tried_s=frames / scene.board.frame_rate,
        frames=methods.total(),
        most_cells=busiest.cells_stepped,
        methods=dict(methods),
        error_steps=error_volts / adc.step,
        frames_per_second=frames / spent_s,
        effects=_planned_effects(scene, busiest),
    )


def _planned_effects(scene: Scene, block: FrameBlock) -> tuple[PlannedEffect, ...]:
    design = scene.skin.design
    assert design.adc is not None
    pressed = block.pressure_kpa.sum(axis=(1, 2)).argmax()
    cells = block.resistance_ohm[pressed]
    usual = np.where(np.isfinite(cells) & (cells > 0), cells, np.inf)
    signal = np.abs(ideal_volts(design, usual) - design.readout.reference_voltage).max()
    found = tuple(_in_steps(effect, float(signal) / design.adc.step) for effect in effects(design, cells))
    noise = scene.board.noise / design.adc.step
    basis = f"board.noise = {scene.board.noise} V"
    return (*found, PlannedEffect("noise at the ADC", scene.board.noise > 0, noise, basis))


def _in_steps(effect: Effect, signal_steps: float) -> PlannedEffect:
    steps = None if effect.estimate is None else effect.estimate * signal_steps
    return PlannedEffect(effect.name, effect.modelled, steps, effect.basis)
