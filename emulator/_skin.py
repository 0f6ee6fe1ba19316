"""The physics of a scene in blocks of frames: contacts to pressure to cells to volts to counts, as arrays over time.

Nothing here depends on the host, on a clock or on how many frames are asked for at a time. Frames are computed ahead in
blocks that are laid out from the first tick of a frame rate on, so that the same seed gives the same bytes whoever asks
and whenever. The first blocks are short, so that the first frame comes soon. Only cells that were touched and have not
come back to rest are stepped.
"""

from __future__ import annotations

import copy
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..circuits import Design, adc_codes, scan_batch
from ..common.arrays import IN_CACHE, CodeArray, FloatArray, IntArray
from ._scene import Scene
from ._spread import Spreading
from ._tuning import LONGEST_BLOCK, LONGEST_DENSE_BLOCK, REST_STEPS


@dataclass(frozen=True, slots=True)
class Sample:
    """Everything about one frame, known only to the emulator. Arrays are (rows, columns)."""

    sequence: int
    time_s: float
    """s since the board started"""
    pressure_kpa: FloatArray
    """on the surface above each cell"""
    resistance_ohm: FloatArray
    """of the cells themselves"""
    volts: FloatArray
    """at the ADC, noise included"""
    counts: CodeArray


@dataclass(frozen=True, slots=True)
class FrameBlock:
    """Consecutive frames of a scene. Arrays are (frames,) or (frames, rows, columns), as in :class:`Sample`."""

    time_us: IntArray
    """us since the board started"""
    pressure_kpa: FloatArray
    resistance_ohm: FloatArray
    volts: FloatArray
    counts: CodeArray
    method: tuple[str, ...]
    """(frames,) how the circuit was solved, as :class:`ohmskin.circuits.BatchResult` says"""
    error_volts: FloatArray
    """(frames,) V by which no output is off, certified; noise not counted"""
    cells_stepped: int
    """cells that were not at rest during the block"""

    def __len__(self) -> int:
        return len(self.time_us)

    def sample(self, frame: int, sequence: int) -> Sample:
        """One frame of the block, under the number that the board gives it."""
        return Sample(
            sequence,
            int(self.time_us[frame]) / 1e6,
            self.pressure_kpa[frame],
            self.resistance_ohm[frame],
            self.volts[frame],
            self.counts[frame],
        )


@dataclass(frozen=True, slots=True)
class Ticks:
    """When frames are due: tick k at ``first_us + round(k period_us)``."""

    period_us: float
    first_us: int = 0

    def at(self, tick: int) -> int:
        """Us since the board started."""
        return self.first_us + round(tick * self.period_us)


class EmulatedSkin:
    """The skin of a scene and the readout behind it, at rest until its first tick.

    Distinguish it from :class:`ohmskin.driver.Skin`, which is a host's view of a real or emulated board, and from
    :class:`._scene.SkinSettings`, the ``[skin]`` table of a scene file.
    """

    def __init__(self, scene: Scene, seed: int = 0, *, ahead: bool = False) -> None:
        """Build the skin.

        Args:
            scene: skin, contacts and circuit.
            seed: draws the noise at the ADC.
            ahead: compute the next block in a thread while this one is read.

        """
        self._scene = scene
        self._ticks = Ticks(1e6 / scene.board.frame_rate)
        self._next_tick = 0
        self._longest = longest_block(scene.skin.design)
        self._length = 1
        self._pool = ThreadPoolExecutor(1, "ohmskin-physics") if ahead else None
        self._next: tuple[ScenePhysics, Future[FrameBlock]] | None = None
        """the physics behind the next block, and that block, where it is computed ahead"""
        self._before = self._physics = ScenePhysics(scene, np.random.default_rng(seed))
        self._block: FrameBlock | None = None
        self._place = 0

    @property
    def next_us(self) -> int:
        """Time of the next frame, in us since the start."""
        return self._ticks.at(self._next_tick)

    @property
    def block(self) -> FrameBlock | None:
        """The block of the latest frame; None before the first."""
        return self._block

    @property
    def frames_ready(self) -> int:
        """Frames that are computed and not read."""
        return 0 if self._block is None else len(self._block) - self._place

    @property
    def is_ready(self) -> bool:
        """Whether the next frame can be read without waiting for the thread that computes ahead."""
        return self.frames_ready > 0 or self._next is None or self._next[1].done()

    def prepare(self) -> None:
        """Compile, or load, what frames are computed with."""
        self._physics.prepare()

    def read(self) -> tuple[FrameBlock, int]:
        """The next frame, as a block and the frame's place in it."""
        if self._block is None or self._place >= len(self._block):
            self._compute()
        assert self._block is not None
        place = self._place
        self._place += 1
        self._next_tick += 1
        return self._block, place

    def set_period(self, period_us: float) -> None:
        """Frames come every ``period_us`` from the next one on, which stays where it was due."""
        next_us = self.next_us
        self._forget_frames_ahead()
        self._ticks, self._next_tick = Ticks(period_us, next_us), 0

    def press(self, pressure_kpa: FloatArray) -> None:
        """From the next frame on ``pressure_kpa`` (rows, columns) lies on the skin, beside the loads of the scene."""
        self._forget_frames_ahead()
        self._physics.by_hand_kpa = pressure_kpa.ravel()

    def _forget_frames_ahead(self) -> None:
        """Frames computed ahead did not happen: live through those before them again."""
        if self._next is not None:
            wait([self._next[1]])
            self._next = None
        if self._block is not None and self._place < len(self._block):
            self._physics = self._before
            if self._place:
                self._physics.run(self._block.time_us[: self._place])
        self._block, self._place, self._length = None, 0, 1

    def _compute(self) -> None:
        if self._next is None:
            physics = self._physics.copy()
            block = physics.run(self._times(self._next_tick))
        else:
            physics, block = self._next[0], self._next[1].result()
        self._before, self._physics = self._physics, physics
        self._block, self._place, self._next = block, 0, None
        if self._pool is not None:
            ahead = physics.copy()
            self._next = ahead, self._pool.submit(ahead.run, self._times(self._next_tick + len(block)))

    def _times(self, first_tick: int) -> IntArray:
        """When the frames of a block are due."""
        times = np.array([self._ticks.at(first_tick + k) for k in range(self._length)])
        self._length = min(self._longest, 2 * self._length)
        return times


def longest_block(design: Design) -> int:
    """Frames of the longest block of a design."""
    rows, columns = design.array.shape
    longest = LONGEST_DENSE_BLOCK if design.board.linear is None else LONGEST_BLOCK
    return min(longest, max(1, IN_CACHE // (rows * columns)))


class ScenePhysics:
    """The state of cells and noise, and how a block of frames changes it. Times never go back."""

    def __init__(self, scene: Scene, noise: np.random.Generator) -> None:
        self._scene = scene
        self._noise = noise
        design = scene.skin.design
        assert design.adc is not None  # a scene is refused without one
        self._shape = design.array.shape
        self._spreading = Spreading(self._shape, scene.skin.spreading_pitches)
        rest_factor, self._sensitivity = scene.skin.spread.draw(self._shape)
        rest_ohm = scene.skin.cell.rest_resistance_ohm * rest_factor
        self._cells = scene.skin.cell.forward(self._shape, rest_resistance_ohm=rest_ohm)
        self._rest_ohm = self._cells.rest_resistance_ohm.ravel()
        self._rest_tolerance = REST_STEPS / 2.0**design.adc.bits
        self._active = np.empty(0, dtype=np.intp)
        self._stepped = 0
        self._time_us: int | None = None
        self._designs: dict[tuple[int, ...], Design] = {(): design}
        self.by_hand_kpa = np.zeros(self._rest_ohm.size)
        """(cells,) load beside those of the scene"""

    def copy(self) -> ScenePhysics:
        """An independent copy, to come back to."""
        return copy.deepcopy(self, {id(self._scene): self._scene, id(self._designs): self._designs})

    def prepare(self) -> None:
        """Let a copy live through two frames with all cells pressed, so that nothing is left to compile for a frame."""
        trial = self.copy()
        trial.by_hand_kpa = np.full(self._rest_ohm.size, self._scene.skin.cell.full_scale_kpa / 100.0)
        trial.run(np.array([0, round(1e6 / self._scene.board.frame_rate)]))

    def run(self, time_us: IntArray) -> FrameBlock:
        """Live through frames at these times; the pressure is taken to change linearly between frames."""
        surface, resistance = self.cells(time_us)
        volts, method, error_volts = self._read(time_us / 1e6, resistance)
        if self._scene.board.noise:
            volts = volts + self._noise.normal(scale=self._scene.board.noise, size=volts.shape)
        counts = adc_codes(self._scene.skin.design, volts)
        return FrameBlock(time_us, surface, resistance, volts, counts, method, error_volts, self._stepped)

    def cells(self, time_us: IntArray) -> tuple[FloatArray, FloatArray]:
        """Live through these times: kPa on the surface and ohm of the cells, both (frames, rows, columns)."""
        time_s = time_us / 1e6
        surface, resistance = self._cells_without_events(time_us)
        for event in self._scene.event:
            if event.changes_cells:
                assert event.place is not None
                place = (slice(None), *event.place)
                resistance[place] = event.changed_cells(time_s, resistance[place])
        if not self._scene.skin.geometry.is_whole:  # no cell, no current
            none = ~self._scene.skin.geometry.exists
            surface[:, none], resistance[:, none] = 0.0, np.inf
        return surface, resistance

    def design(self, time_s: float) -> Design:
        """The circuit as the events of that time leave it."""
        times = np.array([time_s])
        happening = [
            number
            for number, event in enumerate(self._scene.event)
            if not event.changes_cells and event.happening(times)[0]
        ]
        return self._design_during(tuple(happening))

    def _cells_without_events(self, time_us: IntArray) -> tuple[FloatArray, FloatArray]:
        """KPa on the surface and ohm of the cells, both (frames, rows, columns)."""
        frames, time_s, movie = len(time_us), time_us / 1e6, self._scene.movie
        started = time_us[0] if self._time_us is None else self._time_us
        elapsed_s = np.diff(time_us, prepend=started) / 1e6
        self._time_us = int(time_us[-1])
        surface = np.zeros((frames, self._rest_ohm.size))
        if movie is not None and movie.quantity == "resistance":
            self._stepped = 0
            return surface.reshape(frames, *self._shape), movie.at(time_s, self._shape)
        touched, pressure = self._with_hand(*self._scene.pressure_on(time_s))
        surface[:, touched] = pressure
        felt_cells, felt = self._spreading.below(touched, pressure)
        felt = felt * self._sensitivity.flat[felt_cells]

        self._active = np.union1d(self._active, felt_cells)
        self._stepped = len(self._active)
        on_active = np.zeros((frames, len(self._active)))
        on_active[:, np.searchsorted(self._active, felt_cells)] = felt
        resistance = np.repeat(self._rest_ohm[None], frames, axis=0)
        resistance[:, self._active] = self._cells.run(elapsed_s, on_active, self._active)
        self._active = self._active[~self._cells.put_to_rest(self._active, self._rest_tolerance)]
        drift = self._scene.skin.drift.factor(time_s)
        if (drift != 1.0).any():
            resistance *= drift[:, None]
        return surface.reshape(frames, *self._shape), resistance.reshape(frames, *self._shape)

    def _with_hand(self, touched: IntArray, pressure: FloatArray) -> tuple[IntArray, FloatArray]:
        """Cells (k,) and their pressures (frames, k) with the load by hand added."""
        by_hand = np.flatnonzero(self.by_hand_kpa)
        if not by_hand.size:
            return touched, pressure
        cells = np.union1d(touched, by_hand)
        total = np.repeat(self.by_hand_kpa[cells][None], len(pressure), axis=0)
        total[:, np.searchsorted(cells, touched)] += pressure
        return cells, total

    def _read(self, time_s: FloatArray, resistance: FloatArray) -> tuple[FloatArray, tuple[str, ...], FloatArray]:
        """Volts at the ADC, methods and certified errors, each stretch of frames by the circuit that events leave."""
        events = [(k, event) for k, event in enumerate(self._scene.event) if not event.changes_cells]
        happening = np.array([event.happening(time_s) for _, event in events]).reshape(len(events), len(time_s))
        changes = np.flatnonzero((happening[:, 1:] != happening[:, :-1]).any(axis=0)) + 1
        volts, error = np.empty(resistance.shape), np.empty(len(time_s))
        methods: tuple[str, ...] = ()
        for first, last in pairwise([0, *changes.tolist(), len(time_s)]):
            now = tuple(k for (k, _), on in zip(events, happening[:, first], strict=True) if on)
            read = scan_batch(self._design_during(now), resistance[first:last])
            volts[first:last] = read.volts
            error[first:last] = read.error_bound * np.abs(read.volts).max(axis=(1, 2))
            methods += read.method
        return volts, methods, error

    def _design_during(self, events: tuple[int, ...]) -> Design:
        """The design while these events last."""
        if events not in self._designs:
            design = self._scene.skin.design
            for number in events:
                design = self._scene.event[number].changed_design(design)
            self._designs[events] = design
        return self._designs[events]
