"""Random streams of counts of random boards, each made from a family's name and a number.

Five generators share their drawing:

* *plain* families: boards of up to 8 x 8 cells with two fingers that move over the skin;
* *eventful* families: the same boards with other sizes, lines, parts, converters and faults (:func:`_varied`), and
  skins on which something happens in mid-stream (:class:`_Story`);
* *extreme* families: boards at the ends of what is allowed (:func:`_extreme`). Converters have 6 to 24 bits, arrays
  often have a single row or column, lines often have 1 kohm, and cells of 10 ohm and 10 Mohm are neighbours. Noise of
  0.1 to 50 steps begins and ends in mid-stream;
* *twofold* families: boards without amplifiers on which two sets of cells may give the same readings
  (:func:`_twofold`). Whole columns of a few ohm are pressed at once, rows are behind heavy leads, and cells are open;
* *pressed* families: boards with reference resistors of up to 1 Mohm on which all cells are pressed at once
  (:func:`_high_reference`), so that readings stand near their upper end.

A finding is named by family and number. So what an existing family draws must not change: new kinds of boards or events
belong into a new family.
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
    idle_columns: str
    eventful: bool = False
    extreme: bool = False
    twofold: bool = False
    pressed: bool = False


_PLAIN = {
    "inverting": Family("inverting-amplifier", "ground", "float"),
    "row": Family("row-amplifier", "ground", "float"),
    "floating": Family("inverting-amplifier", "float", "float"),
    "divider": Family("voltage-divider", "ground", "float"),
    "loaded": Family("voltage-divider", "ground", "load"),
    "open divider": Family("voltage-divider", "float", "float"),
    "feedback": Family("voltage-feedback", "ground", "float"),
}
_ONLY_EVENTFUL = {
    "row floating": Family("row-amplifier", "float", "float"),
    "open loaded": Family("voltage-divider", "float", "load"),
}
_ALL = _PLAIN | _ONLY_EVENTFUL
_WITHOUT_AMPLIFIERS = "divider", "loaded", "open divider", "open loaded"
FAMILIES = (
    _PLAIN
    | {f"{name} events": family._replace(eventful=True) for name, family in _ALL.items()}
    | {f"{name} extremes": family._replace(eventful=True, extreme=True) for name, family in _ALL.items()}
    | {f"{name} twofold": _ALL[name]._replace(twofold=True) for name in _WITHOUT_AMPLIFIERS}
    | {f"{name} pressed": family._replace(pressed=True) for name, family in _ALL.items()}
)

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
    kind, draw = FAMILIES[family], np.random.default_rng([number, *family.encode()])
    design = draw_design(draw, kind)
    cells = _pressed(draw, design, _skin_of(kind))
    assert design.adc is not None
    noise_steps = _passing_noise(draw, len(cells)) if kind.extreme else _noise(draw, len(cells), kind)
    counts = []
    for frame, noise in zip(cells, noise_steps, strict=True):
        try:
            volts = scan(design, frame).volts
        except SolverError:
            return None
        noisy = volts + draw.normal(scale=noise * design.adc.step, size=volts.shape)
        counts.append(adc_codes(design, noisy))
    return LiveStream(design, cells, noise_steps, counts)


def draw_design(draw: Draw, family: Family) -> Design:
    """A board of a family."""
    tables = _tables(draw, family)
    if family.eventful:
        tables = _varied(draw, tables)
    if family.extreme:
        tables = _extreme(draw, tables)
    if family.twofold:
        tables = _twofold(draw, tables)
    if family.pressed:
        tables = _high_reference(draw, tables)
    return Design.model_validate(tables)


def _noise(draw: Draw, frames: int, family: Family) -> FloatArray:
    """(frames,) ADC steps: the same in all frames, or another one from some frame on."""
    noise = np.full(frames, float(draw.choice([0.0, 0.0, 0.3, 0.5, 2.0])))
    if family.eventful and draw.random() < 0.2:
        noise[int(draw.integers(1, MOVING)) :] = float(draw.choice([0.0, 0.7, 3.0, 20.0]))
    return noise


def _passing_noise(draw: Draw, frames: int) -> FloatArray:
    """(frames,) ADC steps: a noise that begins and ends, in half of the streams."""
    noise = np.full(frames, float(draw.choice([0.0, 0.0, 0.1])))
    if draw.random() < 0.5:
        begin = int(draw.integers(0, MOVING))
        noise[begin : begin + int(draw.integers(1, MOVING))] = float(draw.choice([0.1, 1.0, 5.0, 50.0]))
    return noise


def _tables(draw: Draw, family: Family) -> Tables:
    rows, columns = draw.integers(2, 9, 2).tolist()
    amplified = family.circuit.endswith("amplifier")
    sensed = rows if family.circuit == "row-amplifier" else columns
    lead, segment = (float(draw.choice(values)) for values in ([0.0, 1.0, 5.0, 25.0, 100.0], [0.0, 0.0, 0.2, 2.0]))
    array: Tables = {"rows": rows, "columns": columns, "row_segment": segment, "column_segment": segment}
    array |= {"row_lead": lead, "column_lead": float(draw.choice([0.0, lead, lead]))}
    if draw.random() < 0.2:
        array["row_lead"] = (lead * draw.uniform(0.5, 1.5, rows)).tolist()
    readout: Tables = {"circuit": family.circuit, "idle_columns": family.idle_columns}
    readout["reference_resistance"] = float(draw.choice([1e3, 4.7e3, 10e3, 47e3]))
    adc_range, voltage = [0.0, 3.3], 3.3
    if amplified:
        voltage, adc_range[0] = -1.0, float(draw.choice([0.0, -0.1]))
    if family.circuit != "voltage-divider":
        readout["open_loop_gain"] = float(draw.choice([np.inf, 1e5, 1e3]))
        readout["supply"] = [-0.2, 3.3] if draw.random() < 0.7 else [-np.inf, np.inf]
        if draw.random() < 0.5:
            readout["offset_voltage"] = draw.uniform(-3e-3, 3e-3, sensed).tolist()
    faults = []
    for kind, resistance in (("shorted-cell", 3e3), ("open-cell", 1e4), ("open-cell", np.inf)):
        if draw.random() < 0.05:
            place = [int(draw.integers(rows)), int(draw.integers(columns))]
            faults.append({"kind": kind, "place": place, "resistance": resistance})
    return {
        "array": array,
        "drive": {"voltage": voltage, "idle_rows": family.idle_rows},
        "readout": readout,
        "adc": {"bits": int(draw.choice([8, 10, 12, 16])), "range": adc_range},
        "fault": faults,
    }


def _varied(draw: Draw, tables: Tables) -> Tables:
    """The tables of a board of another size, with parts and converters that the plain families do not have."""
    array, drive, readout, adc = (tables[name] for name in ("array", "drive", "readout", "adc"))
    array["rows"], array["columns"] = shape = _shape(draw)
    sensed = shape[0] if readout["circuit"] == "row-amplifier" else shape[1]
    amplified = readout["circuit"].endswith("amplifier")
    for key, count in (("row_lead", shape[0]), ("column_lead", shape[1])):
        lead = _first(array[key])
        if draw.random() < 0.3:  # a multiplexer's switches, or a long thin lead
            lead = float(10 ** draw.uniform(0.0, 2.6))
        spread = float(draw.choice([0.0, 0.0, 0.1, 0.7]))
        array[key] = (lead * draw.uniform(1.0 - spread, 1.0 + spread, count)).tolist() if spread else lead
    if max(shape) > 8:
        array["row_segment"] = array["column_segment"] = float(draw.choice([0.0, 0.0, 0.05, 0.5]))
    if draw.random() < 0.2:
        readout["reference_resistance"] = (readout["reference_resistance"] * draw.uniform(0.8, 1.25, sensed)).tolist()
    if readout["circuit"] != "voltage-divider":
        readout["open_loop_gain"] = float(draw.choice([np.inf, 1e6, 1e4, 300.0]))
        readout["offset_voltage"] = (
            draw.uniform(-1.0, 1.0, sensed) * float(draw.choice([0.0, 0.0, 3e-4, 5e-3]))
        ).tolist()
        if draw.random() < 0.2:
            readout["bias_current"] = float(draw.choice([1e-9, -1e-7]))
    low, high = draw.choice([(0.0, 3.3), (-0.1, 3.3), (0.2, 3.1), (0.0, 5.0), (-0.5, 2.048)])
    if amplified and draw.random() < 0.3:  # a single supply, around whose middle all moves
        readout["reference_voltage"], drive["voltage"] = 1.0, float(draw.choice([-0.5, 0.8, -1.5]))
        low = 0.0 if drive["voltage"] > 0 else low
    if "supply" in readout:
        limited = draw.random() < 0.6
        readout["supply"] = (
            [min(low, 0.0) - 0.1, high - float(draw.choice([0.0, 0.2, -0.3]))] if limited else [-np.inf, np.inf]
        )
    adc["range"], adc["bits"] = [float(low), float(high)], int(draw.choice([8, 8, 10, 12, 14, 16, 18]))
    if draw.random() < 0.15:
        step = (high - low) / 2.0 ** adc["bits"]
        adc |= {"offset_voltage": float(step * draw.uniform(-1.5, 1.5)), "inl_steps": float(draw.uniform(-1, 1))}
        adc["gain_error"] = float(draw.uniform(-1.0, 1.0) / 2.0 ** adc["bits"])
    tables["fault"] = _faults(draw, shape)
    return tables


def _extreme(draw: Draw, tables: Tables) -> Tables:
    """The tables of a varied board whose lines, size and converter are unusual."""
    array, readout, adc = (tables[name] for name in ("array", "readout", "adc"))
    if draw.random() < 0.4:
        long = int(draw.integers(1, 13))
        array["rows"], array["columns"] = (1, long) if draw.random() < 0.5 else (long, 1)
        tables["fault"] = []
    for key, count in (("row_lead", array["rows"]), ("column_lead", array["columns"])):
        array[key] = _first(array[key])
        if draw.random() < 0.3:
            array[key] = (1e3 * draw.uniform(0.9, 1.1, count)).tolist()
        elif draw.random() < 0.3:
            array[key] = 0.0
    sensed = array["rows"] if readout["circuit"] == "row-amplifier" else array["columns"]
    for key in ("reference_resistance", "offset_voltage"):
        if isinstance(readout.get(key), list):
            readout[key] = np.resize(readout[key], sensed).tolist()
    bits = int(draw.choice([6, 6, 8, 12, 20, 24]))
    coarser = max(1.0, 2.0 ** (adc["bits"] - bits))
    for key in ("offset_voltage", "gain_error"):  # many steps of a finer converter, as many of a coarser one
        if key in adc:
            adc[key] *= coarser
    adc["bits"] = bits
    return tables


def _twofold(draw: Draw, tables: Tables) -> Tables:
    """The tables of a board with light leads and a few heavy ones at its rows, and with converters of up to 20 bits."""
    array, adc = tables["array"], tables["adc"]
    rows = array["rows"]
    lead = np.full(rows, float(draw.choice([0.0, 0.0, 1.0, 5.0, 30.0])))
    heavy = draw.integers(0, rows, int(draw.choice([1, 1, 2, 3])))
    lead[heavy] = 10 ** draw.uniform(1.0, 3.0, len(heavy))
    array["row_lead"], array["column_lead"] = lead.tolist(), float(draw.choice([0.0, 0.0, 5.0, 20.0, 100.0]))
    array["row_segment"] = array["column_segment"] = float(draw.choice([0.0, 0.0, 0.0, 0.2]))
    adc["bits"] = int(draw.choice([8, 10, 12, 16, 20]))
    tables["fault"] = []
    return tables


def _high_reference(draw: Draw, tables: Tables) -> Tables:
    """The tables of a board with light or heavy leads, high references and converters of up to 24 bits."""
    array, readout, adc = (tables[name] for name in ("array", "readout", "adc"))
    lead = float(draw.choice([0.0, 5.0, 50.0, 50.0, 200.0]))
    array["row_lead"], array["column_lead"] = lead, float(draw.choice([0.0, 5.0, 50.0, lead, lead]))
    array["row_segment"] = array["column_segment"] = float(draw.choice([0.0, 0.0, 0.5]))
    readout["reference_resistance"] = float(10 ** draw.uniform(3.0, 6.0))
    if readout["circuit"] != "voltage-divider":
        readout["open_loop_gain"] = float(draw.choice([1e3, 1e4, 1e5, np.inf]))
        readout["offset_voltage"] = float(draw.choice([-5e-3, -2e-3, 0.0, 1e-3, 5e-3]))
    adc["bits"] = int(draw.choice([8, 10, 12, 16, 20, 24]))
    tables["fault"] = []
    return tables


def _shape(draw: Draw) -> tuple[int, int]:
    kind = draw.random()
    if kind < 0.15:
        long = int(draw.integers(1, 17))
        return (1, long) if draw.random() < 0.5 else (long, 1)
    if kind < 0.3:
        rows, columns = draw.integers(8, 17), draw.integers(8, 33)
        return (int(rows), int(columns)) if draw.random() < 0.5 else (min(int(columns), 16), int(rows))
    rows, columns = draw.integers(2, 9, 2)
    return int(rows), int(columns)


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


Skin = Callable[[Draw, FloatArray, FloatArray], FloatArray]


def _pressed(draw: Draw, design: Design, skin: Skin) -> FloatArray:
    """(frames, rows, columns) ohm: two fingers that move, what else happens on the skin, then all at rest."""
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
    cells = skin(draw, np.array(frames), rest)
    return np.concatenate([cells, np.repeat(cells[-1:], HELD, axis=0)])


def _plain_skin(draw: Draw, cells: FloatArray, rest: FloatArray) -> FloatArray:
    """With cells that are open or shorted in all frames."""
    del rest
    if draw.random() < 0.3:
        for _ in range(draw.integers(1, 4)):
            odd = float(draw.choice([np.inf, 1e-2, 1.0, 30.0, 1e8]))
            cells[:, draw.integers(cells.shape[1]), draw.integers(cells.shape[2])] = odd
    return cells


def _varied_skin(draw: Draw, cells: FloatArray, rest: FloatArray) -> FloatArray:
    """With cells that differ much, and up to three events in mid-stream."""
    cells = cells * 10 ** draw.uniform(-1.0, 1.0, rest.shape) ** 3 if draw.random() < 0.2 else cells
    for _ in range(draw.choice([0, 1, 1, 2, 3])):
        start = int(draw.integers(0, MOVING))
        end = int(draw.choice([start + 1, start + 3, MOVING, MOVING]))  # the last frame is held
        story = _Story(draw, cells[start:end], rest)
        events = story.cells_change, story.line_changes, story.all_pressed, story.released
        events[draw.integers(len(events))]()
    return cells


def _extreme_skin(draw: Draw, cells: FloatArray, rest: FloatArray) -> FloatArray:
    """With cells from 10 ohm to 10 Mohm side by side in half of the streams, and events."""
    cells = _varied_skin(draw, cells, rest)
    if draw.random() < 0.5:
        some = draw.random(rest.shape) < draw.choice([0.1, 0.5, 1.0])
        cells[:, some] = 10 ** draw.uniform(1.0, 7.0, int(some.sum()))
    return cells


def _twofold_skin(draw: Draw, cells: FloatArray, rest: FloatArray) -> FloatArray:
    """At rest, then with one to three columns of a few ohm, beside cells that are open."""
    cells[:] = rest * 10 ** draw.uniform(-0.5, 0.5, rest.shape)
    if draw.random() < 0.5:
        cells[:, draw.random(rest.shape) < draw.choice([0.05, 0.2, 0.5])] = np.inf
    begin, end = int(draw.integers(1, 4)), int(draw.choice([9, MOVING, MOVING, MOVING]))  # the last frame is held
    for column in draw.integers(0, rest.shape[1], int(draw.choice([1, 1, 2, 3]))):
        pressed = float(draw.choice([0.3, 1.0, 5.0, 30.0])) * 10 ** draw.uniform(-0.5, 0.5, len(rest))
        some = draw.random(len(rest)) < draw.choice([0.5, 1.0, 1.0])
        cells[begin:end, some, column] = pressed[some]
    return cells


def _hard_pressed_skin(draw: Draw, cells: FloatArray, rest: FloatArray) -> FloatArray:
    """At rest, then with all cells of some ohm to some kiloohm at once, in half of the streams by rows or columns."""
    cells[:] = rest
    shape, begin, later = rest.shape, int(draw.integers(1, 4)), int(draw.integers(6, 9))
    decades = draw.uniform(1.0, 3.5) + draw.uniform(0.0, float(draw.choice([0.1, 0.5, 1.0, 1.5])), shape)
    kind = draw.random()
    if kind < 0.25:
        decades = decades - draw.uniform(0.0, 2.0, (1, shape[1]))
    elif kind < 0.5:
        decades = decades - draw.uniform(0.0, 2.0, (shape[0], 1))
    pressed = np.maximum(10**decades, 1.0)
    cells[begin:later] = pressed
    cells[later:] = np.maximum(pressed * draw.uniform(0.5, 2.0, shape), 1.0)  # the last frame is held
    return cells


def _skin_of(family: Family) -> Skin:
    if family.pressed:
        return _hard_pressed_skin
    if family.twofold:
        return _twofold_skin
    if family.extreme:
        return _extreme_skin
    return _varied_skin if family.eventful else _plain_skin


class _Story:
    """Events: each changes some frames in place."""

    def __init__(self, draw: Draw, frames: FloatArray, rest: FloatArray) -> None:
        """For frames (k, rows, columns) in ohm of a skin whose untouched cells have ``rest`` (rows, columns)."""
        self._draw, self._frames, self._rest = draw, frames, rest

    def cells_change(self) -> None:
        """One to six cells are open, shorted, or nearly so."""
        shape = self._rest.shape
        for _ in range(int(self._draw.choice([1, 1, 2, 3, 6]))):
            odd = float(self._draw.choice([np.inf, 1e-2, 1.0, 30.0, 100.0, 1e8]))
            self._frames[:, self._draw.integers(shape[0]), self._draw.integers(shape[1])] = odd

    def line_changes(self) -> None:
        """The cells of a whole row or column are pressed to their limit, or lose contact."""
        share = float(self._draw.choice([1e-4, 0.01, 0.1, np.inf]))
        if self._draw.random() < 0.5:
            self._frames[:, self._draw.integers(self._rest.shape[0])] *= share
        else:
            self._frames[:, :, self._draw.integers(self._rest.shape[1])] *= share

    def all_pressed(self) -> None:
        """All cells at once are pressed."""
        self._frames *= float(self._draw.choice([0.5, 0.1, 0.02])) * self._draw.uniform(0.8, 1.25, self._rest.shape)

    def released(self) -> None:
        """All cells at once are released."""
        self._frames[:] = self._rest


def _typical_ohm(design: Design) -> float:
    reference = _first(design.readout.reference_resistance)
    if not design.readout.circuit.endswith("amplifier"):
        return reference
    return reference * 0.3 * abs(design.drive.voltage)


def _first(value: float | tuple[float, ...] | list[float]) -> float:
    return value if isinstance(value, float) else value[0]
