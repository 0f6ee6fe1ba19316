"""Random streams of counts of random boards, each made from a family's name and a number.

A family is a circuit and what its idle lines do. All else is drawn, each part by itself, so that rare ones meet: sizes
from a single line to 16 x 16; equal, unequal and heavy leads; references of 1 kohm to 1 Mohm; converters of 6 to 24
bits with errors; faults. Two fingers move over the skin, and up to three events happen in mid-stream: cells, lines or
all cells are pressed, released, opened or shorted. Noise begins and ends. The last cells are held for some frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..circuits import Design, adc_codes, scan
from ..common.arrays import FloatArray
from ..errors import SolverError

MOVING, HELD = 12, 8
"""frames"""


class Family(NamedTuple):
    """What all boards of a family have in common."""

    circuit: str
    idle_rows: str
    idle_columns: str = "float"
    multiplexed: bool = False


FAMILIES = {
    "inverting": Family("inverting-amplifier", "ground"),
    "row": Family("row-amplifier", "ground"),
    "floating": Family("inverting-amplifier", "float"),
    "row floating": Family("row-amplifier", "float"),
    "multiplexed": Family("inverting-amplifier", "float", "ground", multiplexed=True),
    "divider": Family("voltage-divider", "ground"),
    "loaded": Family("voltage-divider", "ground", "load"),
    "open divider": Family("voltage-divider", "float"),
    "open loaded": Family("voltage-divider", "float", "load"),
    "pulled divider": Family("voltage-divider", "pull"),
    "feedback": Family("voltage-feedback", "ground"),
}

Draw = np.random.Generator
Tables = dict[str, Any]


@dataclass(frozen=True)
class LiveStream:
    """Readings of one board."""

    design: Design
    cells: FloatArray
    """(frames, rows, columns) ohm"""
    noise_steps: FloatArray
    """(frames,) standard deviation before the converter, in ADC steps"""
    counts: list[np.ndarray[Any, Any]]
    """for each frame"""

    @property
    def noisy(self) -> bool:
        """Whether any frame has noise."""
        return bool(self.noise_steps.any())


def stream(family: str, number: int) -> LiveStream | None:
    """The stream of one number of a family; None where the board cannot be read at all."""
    draw = np.random.default_rng([number, *family.encode()])
    design = draw_design(draw, FAMILIES[family])
    assert design.adc is not None
    cells, noise_steps, counts = _cells(draw, design), _noise(draw), []
    for frame, noise in zip(cells, noise_steps, strict=True):
        try:
            volts = scan(design, frame, method="exact").volts
        except SolverError:
            return None
        counts.append(adc_codes(design, volts + draw.normal(scale=noise * design.adc.step, size=volts.shape)))
    return LiveStream(design, cells, noise_steps, counts)


def _noise(draw: Draw) -> FloatArray:
    """(frames,) ADC steps: the same in all frames, and in a third of the streams another one for some frames."""
    noise = np.full(MOVING + HELD, float(draw.choice([0.0, 0.0, 0.1, 0.5, 2.0])))
    if draw.random() < 0.33:
        begin = int(draw.integers(0, MOVING))
        end = MOVING + HELD if draw.random() < 0.5 else begin + int(draw.integers(1, MOVING))
        noise[begin:end] = float(draw.choice([0.0, 0.7, 3.0, 20.0, 50.0]))
    return noise


# -- boards ------------------------------------------------------------------------------------------------------------


def draw_design(draw: Draw, family: Family) -> Design:
    """A board of a family."""
    rows, columns = shape = _shape(draw)
    amplified, divider = family.circuit.endswith("amplifier"), family.circuit == "voltage-divider"
    sensed = 1 if family.multiplexed else rows if family.circuit == "row-amplifier" else columns
    lead, segment = float(draw.choice([0.0, 1.0, 5.0, 25.0, 100.0])), float(draw.choice([0.0, 0.0, 0.0, 0.2, 2.0]))
    array: Tables = {"rows": rows, "columns": columns, "row_segment": segment, "column_segment": segment}
    array |= {"row_lead": _leads(draw, lead, rows), "column_lead": _leads(draw, float(draw.choice([0, lead])), columns)}
    drive: Tables = {"voltage": -1.0 if amplified else 3.3, "idle_rows": family.idle_rows}
    if family.idle_rows == "pull":
        drive["idle_row_resistance"] = float(10 ** draw.uniform(2.0, 5.0))
    low, high = [(0.0, 3.3), (0.0, 3.3), (-0.1, 3.3), (0.2, 3.1), (-0.5, 2.048)][draw.integers(5)]
    readout: Tables = {"circuit": family.circuit, "idle_columns": family.idle_columns}
    readout |= {"columns": "multiplexed"} if family.multiplexed else {}
    usual = draw.random() < 0.7
    reference = float(draw.choice([1e3, 4.7e3, 10e3, 47e3]) if usual else 10 ** draw.uniform(3.0, 6.0))
    readout["reference_resistance"] = _unequal(draw, reference, sensed, 0.2)
    if amplified and draw.random() < 0.2:  # a single supply, around whose middle all moves
        readout["reference_voltage"], drive["voltage"] = 1.0, float(draw.choice([-0.5, 0.8, -1.5]))
    if not divider:
        readout["open_loop_gain"] = float(draw.choice([np.inf, 1e6, 1e4, 300.0]))
        offset = float(draw.choice([0.0, 0.0, 3e-4, 5e-3]))
        readout["offset_voltage"] = offset if sensed == 1 else (offset * draw.uniform(-1.0, 1.0, sensed)).tolist()
        if draw.random() < 0.2:
            readout["bias_current"] = float(draw.choice([1e-9, -1e-7]))
        limits = [min(low, 0.0) - 0.1, high - float(draw.choice([0.0, 0.2, -0.3]))]
        readout["supply"] = limits if draw.random() < 0.6 else [-np.inf, np.inf]
    adc: Tables = {"bits": int(draw.choice([6, 8, 8, 10, 10, 12, 12, 14, 16, 20, 24])), "range": [low, high]}
    if draw.random() < 0.15:
        step = (high - low) / 2.0 ** adc["bits"]
        adc |= {"offset_voltage": float(step * draw.uniform(-1.5, 1.5)), "inl_steps": float(draw.uniform(-1, 1))}
        adc["gain_error"] = float(draw.uniform(-1.0, 1.0) / 2.0 ** adc["bits"])
    faults = _faults(draw, shape)
    return Design.model_validate({"array": array, "drive": drive, "readout": readout, "adc": adc, "fault": faults})


def _shape(draw: Draw) -> tuple[int, int]:
    kind = draw.random()
    if kind < 0.15:
        long = int(draw.integers(1, 17))
        return (1, long) if draw.random() < 0.5 else (long, 1)
    rows, columns = draw.integers(8, 17, 2) if kind < 0.25 else draw.integers(2, 9, 2)
    return int(rows), int(columns)


def _leads(draw: Draw, lead: float, count: int) -> float | list[float]:
    """Ohm of the lines' leads: alike, unequal, those of a multiplexer's switches or of a long line, or a few heavy."""
    kind = draw.random()
    if kind < 0.2:
        return _unequal(draw, float(draw.choice([10 ** draw.uniform(0.0, 2.6), 1e3])), count, 0.5)
    if kind < 0.3:
        heavy = np.full(count, lead)
        heavy[draw.integers(0, count, 2)] = 10 ** draw.uniform(1.0, 3.0, 2)
        return [float(each) for each in heavy]
    return _unequal(draw, lead, count, 0.3)


def _unequal(draw: Draw, value: float, count: int, share: float) -> float | list[float]:
    """One value, or in a ``share`` of the cases others on each line."""
    if count == 1 or draw.random() > share:
        return value
    spread = float(draw.choice([0.1, 0.25, 0.7]))
    return [value * float(each) for each in draw.uniform(1.0 - spread, 1.0 + spread, count)]


def _faults(draw: Draw, shape: tuple[int, int]) -> list[Tables]:
    kinds = [("shorted-cell", 3e3), ("shorted-cell", 300.0), ("open-cell", 1e3), ("open-cell", np.inf)]
    kinds += [("broken-row", 300.0), ("broken-column", 50.0)]
    kinds += [("bridged-rows", 2e3)] if shape[0] > 1 else []
    kinds += [("bridged-columns", 1e3)] if shape[1] > 1 else []
    faults = []
    for kind, resistance in kinds:
        if draw.random() < 0.03:
            row, column = int(draw.integers(shape[0])), int(draw.integers(shape[1]))
            row -= int(kind == "bridged-rows" and row == shape[0] - 1)
            column -= int(kind == "bridged-columns" and column == shape[1] - 1)
            faults.append({"kind": kind, "place": [row, column], "resistance": resistance})
    return faults


# -- skins -------------------------------------------------------------------------------------------------------------


def _cells(draw: Draw, design: Design) -> FloatArray:
    """(frames, rows, columns) ohm: two fingers that move, events, then all is held."""
    shape = design.array.shape
    # At rest a reading is a tenth to a third of full scale.
    rest = _typical_ohm(design) * 10 ** draw.uniform(0.3, 1.0) * 10 ** draw.uniform(-0.1, 0.1, shape)
    hard = float(draw.choice([0.3, 0.1, 0.02]))  # resistance under a finger, over that at rest
    place, row, column = draw.uniform(0, 1, (2, 2)) * shape, *np.indices(shape)
    frames = []
    for number in range(MOVING):
        place = (place + draw.normal(0.0, 0.15, (2, 2))) % shape
        load = sum(
            np.exp(-((row - at[0]) ** 2 + (column - at[1]) ** 2)) * (0.5 + 0.5 * np.sin(number / 4 + k))
            for k, at in enumerate(place)
        )
        frames.append(rest / (1.0 + np.minimum(load, 1.0) ** 2 * (1.0 / hard - 1.0)))
    cells = np.array(frames)
    if draw.random() < 0.15:  # neighbours of 10 ohm and 10 Mohm, some cells or all
        some = draw.random(shape) < draw.choice([0.1, 0.5, 1.0])
        cells[:, some] = 10 ** draw.uniform(1.0, 7.0, int(some.sum()))
    for _ in range(draw.choice([0, 1, 1, 2, 3])):
        start = int(draw.integers(0, MOVING))
        end = int(draw.choice([start + 1, start + 3, MOVING, MOVING]))  # the last frame is held
        _EVENTS[draw.integers(len(_EVENTS))](draw, cells[start:end], rest)
    return np.concatenate([cells, np.repeat(cells[-1:], HELD, axis=0)])


def _cells_change(draw: Draw, frames: FloatArray, rest: FloatArray) -> None:
    """One to six cells are open, shorted, or nearly so."""
    for _ in range(int(draw.choice([1, 1, 2, 3, 6]))):
        odd = float(draw.choice([np.inf, 1e-2, 1.0, 30.0, 100.0, 1e8]))
        frames[:, draw.integers(rest.shape[0]), draw.integers(rest.shape[1])] = odd


def _line_changes(draw: Draw, frames: FloatArray, rest: FloatArray) -> None:
    """The cells of a whole row or column are pressed to their limit, or lose contact."""
    line = np.s_[:, draw.integers(rest.shape[0])] if draw.random() < 0.5 else np.s_[:, :, draw.integers(rest.shape[1])]
    frames[line] *= float(draw.choice([1e-4, 0.01, 0.1, np.inf]))


def _columns_are_pressed(draw: Draw, frames: FloatArray, rest: FloatArray) -> None:
    """The cells of one to three columns have a few ohm, beside cells that are open in half of the cases."""
    if draw.random() < 0.5:
        frames[:, draw.random(rest.shape) < draw.choice([0.05, 0.2, 0.5])] = np.inf
    for column in draw.integers(0, rest.shape[1], int(draw.choice([1, 1, 2, 3]))):
        pressed = float(draw.choice([0.3, 1.0, 5.0, 30.0])) * 10 ** draw.uniform(-0.5, 0.5, len(rest))
        some = draw.random(len(rest)) < draw.choice([0.5, 1.0, 1.0])
        frames[:, some, column] = pressed[some]


def _all_are_pressed(draw: Draw, frames: FloatArray, rest: FloatArray) -> None:
    """All cells at once, by some factor, or to some ohm to some kiloohm, in half of these cases by rows or columns."""
    if draw.random() < 0.5:
        frames *= float(draw.choice([0.5, 0.1, 0.02])) * draw.uniform(0.8, 1.25, rest.shape)
        return
    decades = draw.uniform(1.0, 3.5) + draw.uniform(0.0, float(draw.choice([0.1, 0.5, 1.0, 1.5])), rest.shape)
    lines = [(1, 1), (1, 1), (1, rest.shape[1]), (rest.shape[0], 1)][draw.integers(4)]
    frames[:] = np.maximum(10 ** (decades - draw.uniform(0.0, 2.0, lines)), 1.0)


def _all_are_released(draw: Draw, frames: FloatArray, rest: FloatArray) -> None:
    frames[:] = rest


_EVENTS: tuple[Callable[[Draw, FloatArray, FloatArray], None], ...] = (
    _cells_change,
    _line_changes,
    _columns_are_pressed,
    _all_are_pressed,
    _all_are_released,
)


def _typical_ohm(design: Design) -> float:
    reference = design.readout.reference_resistance
    ohm = reference if isinstance(reference, float) else reference[0]
    return ohm * 0.3 * abs(design.drive.voltage) if design.readout.circuit.endswith("amplifier") else ohm
