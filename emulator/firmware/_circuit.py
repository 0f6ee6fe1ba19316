"""The analog part of the board over time: a scene's skin, the switched rows, the amplifiers, the ADC's input."""

from __future__ import annotations

import numpy as np

from ...circuits import Design, Fault, Transient, adc_codes, scan, volts_of_codes
from ...common.arrays import FloatArray
from .._hand import Hand
from .._scene import Scene
from .._skin import ScenePhysics
from .._tuning import CELLS_PERIOD_S, SAME_RESISTANCE

_NO_DRIVE = 1e-6
"""V: stands for a drive of zero; it is the smallest that a design may have, and moves outputs by microvolts"""
REFERENCE_RESISTORS_OHM = (10e3, 15e3)
"""on even and on odd columns, as ``firmware/describe.py`` tells the firmware"""


class ScanCircuit:
    """Skin and readout of a scene, at times and with row selections that the program decides."""

    def __init__(self, scene: Scene, seed: int, hand: Hand | None = None) -> None:
        """Start with no row selected and everything settled.

        Args:
            scene: its design has amplifiers and an ADC.
            seed: for the noise at the ADC.
            hand: presses beside the scene's contacts.

        Raises:
            InputError: the design's circuit has no dynamic model.

        """
        self._noise_volts = scene.board.noise
        self._random = np.random.default_rng(seed)
        self._physics = ScenePhysics(scene, self._random)
        self._hand = hand
        self._design = self._physics.design(0.0)
        surface, cells = self._physics.cells(np.array([0]))
        self.pressure_kpa: FloatArray = surface[0]
        """(rows, columns) on the surface at the last update"""
        self.resistance_ohm: FloatArray = cells[0]
        """(rows, columns) of the cells at the last update"""
        self._cells_fixed = False
        self._updated_s = 0.0
        self._time_s = 0.0
        self._rows: frozenset[int] = frozenset()
        self._transient = Transient(self._design, self.resistance_ohm)
        self._solve()

    def prepare(self) -> None:
        """Compile, or load, what the cells are computed with."""
        self._physics.prepare()

    def select(self, time_s: float, rows: frozenset[int]) -> None:
        """Other rows are pulled to ground from now on; index ``rows`` of the array is the reference resistors."""
        self._advance(time_s)
        self._rows = rows
        if not self._cells_fixed and time_s - self._updated_s >= CELLS_PERIOD_S:
            self._update_cells(time_s)
        self._aim()

    def hold_cells(self, resistance: FloatArray) -> None:
        """From now on the cells have these resistances, (rows, columns) ohm, whatever the scene says."""
        self._cells_fixed = True
        self._change(self._design, self._design.resistance(resistance))
        self._aim()

    def connect(self, time_s: float, column: int) -> None:
        """A conversion of a column begins."""
        self._advance(time_s)
        self._transient.connect(column)

    def sample(self, time_s: float) -> float:
        """End of the acquisition: V at the converter, noise included."""
        self._advance(time_s)
        volts = self._transient.disconnect()
        return volts + float(self._random.normal(scale=self._noise_volts)) if self._noise_volts else volts

    def code_volts(self, volts: float) -> float:
        """Input of an ideal converter, V, that reads as ``volts`` do with the offset, gain and bow of this one."""
        converted = adc_codes(self._design, np.array([volts]))
        return float(volts_of_codes(self._design, converted)[0])

    def _advance(self, time_s: float) -> None:
        self._transient.advance(time_s - self._time_s)
        self._time_s = max(self._time_s, time_s)

    def _update_cells(self, time_s: float) -> None:
        self._updated_s = time_s
        by_hand = None if self._hand is None else self._hand.take_change()
        if by_hand is not None:
            self._physics.by_hand_kpa = by_hand.ravel()
        surface, cells = self._physics.cells(np.array([round(time_s * 1e6)]))
        self.pressure_kpa = surface[0]
        self._change(self._physics.design(time_s), cells[0])
        if by_hand is not None:
            assert self._hand is not None
            self._hand.in_force(time_s)  # since power-up, a few ms more than the time in the frames

    def _change(self, design: Design, resistance: FloatArray) -> None:
        """The circuit is this one from now on; it is solved again only if that makes a difference."""
        self.resistance_ohm = resistance
        same = design is self._design and np.allclose(resistance, self._solved_for, rtol=SAME_RESISTANCE, atol=0.0)
        if not same:
            self._design = design
            self._transient.change(design, resistance)
            self._solve()

    def _solve(self) -> None:
        """Settled outputs of every row, of none, and (when it is asked for) of the reference resistors."""
        self._solved_for = self.resistance_ohm
        self._settled = scan(self._design, self.resistance_ohm, method="exact").volts
        undriven = self._design.replace(drive={"voltage": _NO_DRIVE})
        self._idle = scan(undriven, self.resistance_ohm, method="exact").volts[0]
        self._reference: FloatArray | None = None

    def _aim(self) -> None:
        """Settled outputs of the rows that are selected now: superposition, if a program selects several."""
        target = self._idle.copy()
        for row in self._rows:
            target += self._outputs_of(row) - self._idle
        if self._rows:
            low, high = self._design.readout.supply
            self._transient.aim(np.clip(target, low, high), min(*self._rows, self._design.array.rows - 1))
        else:
            self._transient.aim(target)

    def _outputs_of(self, row: int) -> FloatArray:
        if row < len(self._settled):
            settled: FloatArray = self._settled[row]
            return settled
        if self._reference is None:
            self._reference = reference_outputs(self._design, self.resistance_ohm)
        return self._reference


def reference_outputs(design: Design, resistance: FloatArray) -> FloatArray:
    """Outputs (columns,) in V with the row of reference resistors selected.

    The resistors join the far ends of the column lines, before row 0. Their common switch leads to ground when it is
    selected and nowhere otherwise, so that they are in the circuit in this step only.
    """
    array = design.array
    known = np.resize(REFERENCE_RESISTORS_OHM, array.columns)
    extended = design.replace(
        array={"rows": array.rows + 1, "row_lead": _before(array.row_lead), "row_segment": _before(array.row_segment)},
        fault=tuple(_one_row_further(fault) for fault in design.fault),
    )
    outputs: FloatArray = scan(extended, np.vstack([known, resistance]), method="exact").volts[0]
    return outputs


def _before(value: float | tuple[float, ...]) -> float | tuple[float, ...]:
    return (value[0], *value) if isinstance(value, tuple) else value


def _one_row_further(fault: Fault) -> Fault:
    row, column = fault.place
    onwards = fault.to + 1 if fault.to is not None and fault.kind == "bridged-rows" else fault.to
    return fault.replace(place=(row + 1, column), to=onwards)
