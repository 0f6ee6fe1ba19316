"""The readout as a schematic in SVG, drawn from the design with its values (the paper's Fig. 15)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ..circuits import Design, LineEnds
from ._units import engineering

_STROKE = 'stroke="currentColor" stroke-width="1.4"'
_PAPER = 'fill="var(--paper, white)"'
PITCH_X, PITCH_Y = 260.0, 120.0
LEFT, TOP = 270.0, 60.0


class _Drawing:
    """SVG elements; coordinates in px."""

    def __init__(self) -> None:
        self.elements: list[str] = []

    def line(self, *points: tuple[float, float]) -> None:
        path = " ".join(f"{x:g},{y:g}" for x, y in points)
        self.elements.append(f'<polyline points="{path}" fill="none" {_STROKE}/>')

    def dot(self, x: float, y: float) -> None:
        self.elements.append(f'<circle cx="{x:g}" cy="{y:g}" r="2.6" fill="currentColor"/>')

    def text(self, x: float, y: float, words: str, *, anchor: str = "middle", size: float = 11.0) -> None:
        safe = words.replace("&", "&amp;").replace("<", "&lt;")
        self.elements.append(
            f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" font-size="{size:g}" fill="currentColor">{safe}</text>'
        )

    def lines(self, x: float, y: float, texts: Iterable[str], *, size: float) -> None:
        """Texts below each other."""
        for number, words in enumerate(filter(None, texts)):
            self.text(x, y + 13 * number, words, anchor="start", size=size)

    def box(self, x: float, y: float, width: float, height: float, stroke: str = _STROKE) -> None:
        """Around (x, y); wires are interrupted by it."""
        corner = f'x="{x - width / 2:g}" y="{y - height / 2:g}" width="{width:g}" height="{height:g}"'
        self.elements.append(f"<rect {corner} {_PAPER} {stroke}/>")

    def resistor(self, x: float, y: float, *, vertical: bool = False, length: float = 36.0) -> None:
        self.box(x, y, *((12.0, length) if vertical else (length, 12.0)))

    def capacitor(self, x: float, y: float) -> None:
        """Two plates around (x, y) in a vertical wire."""
        self.box(x, y, 18, 6, 'stroke="none"')
        for plate in (y - 3, y + 3):
            self.line((x - 9, plate), (x + 9, plate))

    def ground(self, x: float, y: float) -> None:
        for half, down in ((9, 0), (6, 4), (3, 8)):
            self.line((x - half, y + down), (x + half, y + down))

    def amplifier(self, x: float, y: float) -> None:
        """A triangle that points down from (x, y): inputs 20 px to the left (-) and right (+), output at y + 52."""
        corners = f"{x - 34:g},{y:g} {x + 34:g},{y:g} {x:g},{y + 52:g}"
        self.elements.append(f'<polygon points="{corners}" {_PAPER} {_STROKE}/>')
        self.text(x - 17, y + 15, "−", size=14)
        self.text(x + 17, y + 15, "+", size=14)

    def svg(self, width: float, height: float, title: str) -> str:
        body = "".join(self.elements)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
            f'role="img" aria-label="{title}" font-family="sans-serif">{body}</svg>'
        )


def schematic(design: Design) -> str:
    """An excerpt of two rows and two columns (fewer, if the array has fewer) with the values of all parts."""
    board, kind = design.board, design.board.line_kinds[1]
    rows, columns = (min(count, 2) for count in board.shape)
    segment, lead = (getattr(design.array, f"{kind}_{part}") for part in ("segment", "lead"))
    drawing = _Drawing()
    right, bottom = LEFT + (columns - 1) * PITCH_X, TOP + (rows - 1) * PITCH_Y
    for row in range(rows):
        _row(drawing, design, row, right)
    for column in range(columns):
        x = LEFT + column * PITCH_X + 55
        drawing.line((x, TOP + 45), (x, bottom + 90))
        for row in range(rows):
            y = TOP + row * PITCH_Y
            cell_x = LEFT + column * PITCH_X
            drawing.line((cell_x, y), (cell_x, y + 45), (x, y + 45))
            drawing.resistor(cell_x, y + 25, vertical=True, length=26)
            drawing.dot(cell_x, y)
            drawing.dot(x, y + 45)
            drawing.text(cell_x - 12, y + 29, f"R{_place(design, row, column)}", anchor="end")
            if row + 1 < rows and _some(segment):
                drawing.resistor(x, y + 85, vertical=True, length=24)
                if column == 0:
                    drawing.text(x + 10, y + 89, _value(segment, "ohm"), anchor="start")
        if _some(lead):
            drawing.resistor(x, bottom + 70, vertical=True, length=26)
            if column == 0:
                drawing.text(x + 10, bottom + 74, f"lead {_value(lead, 'ohm')}", anchor="start")
        _end(drawing, design, x, bottom + 90, label=column == 0)
    size = f"{design.array.rows} × {design.array.columns} cells"
    what = "networks at the lines' ends" if design.is_described else design.readout.circuit
    drawing.text(LEFT + 55, 22, f"{what}, {size}; drawn: {_drawn(design)}", size=13)
    if ends := _networks(design):
        shared = {"at each cell": ends.crosspoint, "reference": ends.reference}
        words = (f"{where}: {', '.join(card.line() for card in cards)}" for where, cards in shared.items() if cards)
        drawing.lines(LEFT + 55, bottom + 250, words, size=10.5)
    return drawing.svg(right + 330, bottom + 330, f"schematic: {what}, {size}")


def _networks(design: Design) -> LineEnds | None:
    """The networks that a design describes at its lines' ends; None of a named circuit."""
    return design.board.line_ends if design.is_described else None


def _row(drawing: _Drawing, design: Design, row: int, right: float) -> None:
    y = TOP + row * PITCH_Y
    kind = design.board.line_kinds[0]
    segment, lead = (getattr(design.array, f"{kind}_{part}") for part in ("segment", "lead"))
    drawing.line((140, y), (right + 20, y))
    drawing.text(132, y - 3, f"{kind} {design.board.driven_line(row)}", anchor="end", size=12)
    if ends := _networks(design):
        cards = ends.idle[row] if row else ends.selected[row]
        words = ["idle:" if row else "selected:", *(card.line() for card in cards)]
        drawing.lines(4, y + 14, words if cards else ["idle: open"], size=10.5)
    else:
        _driver(drawing, design, row)
    if _some(lead):
        drawing.resistor(190, y)
        if row == 0:
            drawing.text(190, y - 12, f"lead {_value(lead, 'ohm')}")
    if right > LEFT and _some(segment):
        drawing.resistor(LEFT + PITCH_X / 2 + 25, y, length=28)
        if row == 0:
            drawing.text(LEFT + PITCH_X / 2 + 25, y - 12, f"segment {_value(segment, 'ohm')}")


def _driver(drawing: _Drawing, design: Design, row: int) -> None:
    """What a named circuit drives the row with, or lets it idle at."""
    y, drive = TOP + row * PITCH_Y, engineering(design.drive.voltage, "V")
    idle = {"ground": "at the reference", "float": "open", "pull": "open"}[design.drive.idle_rows]
    if design.board.circuit.drives_idle_lines:
        idle = "at the follower"
    elif design.board.pulled:
        drawing.line((LEFT - 52, y), (LEFT - 52, y + 70))
        drawing.resistor(LEFT - 52, y + 36, vertical=True, length=26)
        _reference(drawing, design, LEFT - 52, y + 70)
        drawing.dot(LEFT - 52, y)
        if row == 0:
            drawing.text(LEFT - 64, y + 40, _value(design.drive.idle_row_resistance, "ohm"), anchor="end")
    words = f"selected: {drive}" if row == 0 else f"idle: {idle}"
    drawing.text(132, y + 12, words, anchor="end", size=10.5)


def _drawn(design: Design) -> str:
    """Which lines the drawing shows; a circuit that senses the array's rows is drawn transposed."""
    if design.board.transposed:
        return "transposed, for the array's columns are driven and its rows sensed"
    return "the first rows and columns"


def _place(design: Design, row: int, column: int) -> str:
    """The array's row and column of a cell that is drawn at the crosspoint of two lines."""
    places = design.board.driven_line(row), design.board.sensed_line(column)
    return "{},{}".format(*(places[::-1] if design.board.transposed else places))


def _end(drawing: _Drawing, design: Design, x: float, y: float, *, label: bool) -> None:
    readout = design.readout
    if ends := _networks(design):
        drawing.line((x, y), (x, y + 70))
        drawing.box(x, y + 55, 90, 30)
        drawing.text(x, y + 59, "network")
        if label:
            drawing.lines(x + 55, y + 48, (card.line() for card in ends.read[0]), size=10.5)
        _converter(drawing, design, x, y + 95, label=label)
        drawing.line((x, y + 70), (x, y + 95))
        return
    if design.board.multiplexed:  # the switch stands open at idle columns
        kind, part = design.board.line_kinds[1], "amplifier" if design.board.circuit.virtual_ground else "load"
        idle = {"float": "open", "ground": "at the reference", "load": "at loads of their own"}[readout.idle_columns]
        drawing.dot(x, y)
        if label:
            drawing.lines(x + 12, y + 2, (f"one {part} behind a switch,", f"idle {kind}s {idle}"), size=10.5)
    if not design.board.circuit.virtual_ground:
        drawing.line((x, y), (x, y + 30))
        drawing.line((x, y + 30), (x, y + 110))
        drawing.resistor(x, y + 70, vertical=True)
        _reference(drawing, design, x, y + 110)
        drawing.line((x, y + 30), (x + 60, y + 30))
        drawing.dot(x, y + 30)
        if label:
            drawing.text(x + 12, y + 74, _value(readout.reference_resistance, "ohm"), anchor="start")
            if words := design.board.circuit.behind_the_load:
                drawing.text(x + 12, y + 100, words, anchor="start")
        _converter(drawing, design, x + 60, y + 30, label=label)
        return
    drawing.line((x, y), (x, y + 60), (x + 10, y + 60), (x + 10, y + 66))
    drawing.dot(x, y + 30)
    top, out = y + 66, y + 66 + 52
    amplifier_x = x + 27
    drawing.amplifier(amplifier_x, top)
    drawing.line((amplifier_x + 17, top), (amplifier_x + 17, top - 10), (amplifier_x + 46, top - 10))
    drawing.line((amplifier_x + 46, top - 10), (amplifier_x + 46, top + 4))
    _reference(drawing, design, amplifier_x + 46, top + 4)
    drawing.line((amplifier_x, out), (amplifier_x, out + 26))
    side = x - 48
    drawing.line((x, y + 30), (side, y + 30), (side, out + 12), (amplifier_x, out + 12))
    drawing.resistor(side, y + 80, vertical=True)
    drawing.dot(amplifier_x, out + 12)
    if readout.feedback_capacitance:
        drawing.line((x, y + 40), (side + 24, y + 40), (side + 24, out + 4), (amplifier_x, out + 4))
        drawing.capacitor(side + 24, y + 80)
    if label:
        drawing.text(side - 10, y + 76, "Rref", anchor="end")
        drawing.text(side - 10, y + 91, _value(readout.reference_resistance, "ohm"), anchor="end")
        if readout.feedback_capacitance:
            drawing.text(
                side - 10, y + 112, f"Cf {engineering(readout.feedback_capacitance, 'F')}", anchor="end", size=11
            )
        values = [
            f"gain {_value(readout.open_loop_gain, '')}" if np.all(np.isfinite(readout.open_loop_gain)) else "",
            f"GBW {engineering(readout.gain_bandwidth, 'Hz')}" if np.isfinite(readout.gain_bandwidth) else "",
            f"offset {_value(readout.offset_voltage, 'V')}" if _some(readout.offset_voltage) else "",
            f"swing {readout.supply[0]:g} … {readout.supply[1]:g} V" if np.isfinite(readout.supply).any() else "",
        ]
        drawing.lines(amplifier_x + 40, top + 26, values, size=10)
    _converter(drawing, design, amplifier_x, out + 26, label=label)


def _reference(drawing: _Drawing, design: Design, x: float, y: float) -> None:
    """What unselected lines and amplifiers stand at: a supply bar with its voltage, or earth where that is 0 V."""
    volts = design.readout.reference_voltage
    if not volts:
        drawing.ground(x, y)
        return
    drawing.line((x, y), (x, y + 6))
    drawing.line((x - 9, y + 6), (x + 9, y + 6))
    drawing.text(x, y + 19, engineering(volts, "V"), size=10)


def _converter(drawing: _Drawing, design: Design, x: float, y: float, *, label: bool) -> None:
    adc = design.adc
    drawing.box(x, y + 12, 48, 24, f'{_STROKE} stroke-dasharray="{"none" if adc else "3 3"}"')
    drawing.text(x, y + 16, "ADC")
    if label and adc:
        drawing.text(x + 32, y + 12, f"{adc.bits} bit, {adc.range[0]:g} … {adc.range[1]:g} V", anchor="start", size=10)


def _some(value: float | Sequence[float]) -> bool:
    return bool(np.any(np.asarray(value)))


def _value(value: float | Sequence[float], unit: str) -> str:
    """One value, or the range of a list of them."""
    values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    low, high = float(values.min()), float(values.max())
    if low == high:
        return engineering(low, unit)
    return f"{engineering(low, unit)} … {engineering(high, unit)}"
