"""Boards drawn in KiCad: netlists as people draw them become designs, and designs become netlists and come back."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.circuits import Design, scan
from ohmskin.cli import run
from ohmskin.common.config import parse, read_toml
from ohmskin.errors import InputError
from ohmskin.kicad import Imported, differences, import_design, parse_netlist, read_netlist, shape_of_layout, to_netlist

ROOT = Path(__file__).parents[1]
MUX_4067 = ["9", "8", "7", "6", "5", "4", "3", "2", "23", "22", "21", "20", "19", "18", "17", "16"]
MUX_4051 = ["13", "14", "15", "12", "1", "5", "2", "4"]


class Sheet:
    """A schematic: parts with the nets of their pins."""

    def __init__(self) -> None:
        self.parts: dict[str, tuple[str, str, dict[str, str], dict[str, str]]] = {}

    def add(self, ref: str, value: str, kind: str, pins: Mapping[str, str], **fields: str) -> None:
        self.parts[ref] = value, kind, dict(pins), {name.replace("_", "."): text for name, text in fields.items()}

    def connector(self, ref: str, nets: list[str], **fields: str) -> None:
        self.add(ref, "Conn", f"Conn_01x{len(nets):02d}", {str(k + 1): net for k, net in enumerate(nets)}, **fields)

    def nets(self) -> dict[str, list[tuple[str, str]]]:
        found: dict[str, list[tuple[str, str]]] = {}
        for ref, (_, _, pins, _) in self.parts.items():
            for number, net in pins.items():
                found.setdefault(net, []).append((ref, number))
        return found

    def as_text(self) -> str:
        q = json.dumps
        lines = ['(export (version "E") (components']
        for ref, (value, kind, _, fields) in self.parts.items():
            own = " ".join(f"(field (name {q(name)}) {q(text)})" for name, text in fields.items())
            lines.append(
                f"(comp (ref {q(ref)}) (value {q(value)}) (fields {own}) (libsource (lib x) (part {q(kind)})))"
            )
        lines.append(") (nets")
        for name, nodes in self.nets().items():
            inner = " ".join(f"(node (ref {q(ref)}) (pin {q(number)}) (pintype passive))" for ref, number in nodes)
            lines.append(f"(net (code 1) (name {q(name)}) {inner})")
        return "\n".join([*lines, "))"])

    def as_xml(self) -> str:
        a = quoteattr
        lines = ['<?xml version="1.0"?><export version="E"><components>']
        for ref, (value, kind, _, fields) in self.parts.items():
            own = "".join(f"<field name={a(name)}>{text}</field>" for name, text in fields.items())
            lines.append(f"<comp ref={a(ref)}><value>{value}</value><fields>{own}</fields>")
            lines.append(f'<libsource lib="x" part={a(kind)}/></comp>')
        lines.append("</components><nets>")
        for name, nodes in self.nets().items():
            inner = "".join(f"<node ref={a(ref)} pin={a(number)}/>" for ref, number in nodes)
            lines.append(f'<net code="1" name={a(name)}>{inner}</net>')
        return "".join([*lines, "</nets></export>"])

    def imported(self, tmp_path: Path, *, xml: bool = False) -> Imported:
        file = tmp_path / "board.net"
        file.write_text(self.as_xml() if xml else self.as_text())
        return import_design(read_netlist(file))


def lines(stem: str, count: int) -> list[str]:
    return [f"/{stem}{k}" for k in range(count)]


def two_multiplexers() -> Sheet:
    """The usual mat: a multiplexer puts 5 V on a row, another one puts a column on a load and a pin."""
    sheet = Sheet()
    sheet.connector("J1", lines("ROW", 16))
    sheet.connector("J2", lines("COL", 16))
    sheet.add("U1", "CD74HC4067M", "CD74HC4067M", {"1": "+5V", **dict(zip(MUX_4067, lines("ROW", 16), strict=True))})
    sheet.add("U2", "CD74HC4067M", "CD74HC4067M", {"1": "/SENSE", **dict(zip(MUX_4067, lines("COL", 16), strict=True))})
    sheet.add("R1", "4k7", "R", {"1": "/SENSE", "2": "GND"}, Tolerance="1%")
    nano = {str(k): f"/D{k}" for k in range(1, 15)} | {"19": "/SENSE", "27": "+5V", "4": "GND"}
    sheet.add("A1", "Arduino_Nano_v3.x", "Arduino_Nano_v3.x", nano)
    return sheet


def shift_registers_and_amplifiers() -> Sheet:
    """Rows on shift registers, an inverting amplifier on each column, a reference from a divider."""
    sheet = Sheet()
    sheet.connector("J1", [*lines("R", 8), "GND"])
    sheet.connector("J2", lines("C", 4))
    outputs = ["15", "1", "2", "3", "4", "5", "6", "7"]
    sheet.add("U1", "74HC595", "74HC595", {"16": "+3V3", "8": "GND", **dict(zip(outputs, lines("R", 8), strict=True))})
    units = [("2", "3", "1"), ("6", "5", "7"), ("9", "10", "8"), ("13", "12", "14")]
    pins = {"4": "+3V3", "11": "GND"}
    for k, (inverting, other, output) in enumerate(units):
        pins |= {inverting: f"/C{k}", other: "/VMID", output: f"/OUT{k}"}
        sheet.add(f"R{k + 1}", "10k", "R", {"1": f"/C{k}", "2": f"/OUT{k}"})
        sheet.add(f"C{k + 1}", "100p", "C", {"1": f"/OUT{k}", "2": f"/C{k}"})
    sheet.add("U2", "MCP6004", "MCP6004", pins)
    sheet.add("R11", "10k", "R", {"1": "+3V3", "2": "/VMID"})
    sheet.add("R12", "10k", "R", {"1": "/VMID", "2": "GND"})
    controller = {"1": "/OUT0", "2": "/OUT1", "3": "/OUT2", "4": "/OUT3", **{str(k): f"/IO{k}" for k in range(5, 20)}}
    sheet.add("U3", "ESP32-WROOM-32", "ESP32-WROOM-32", controller)
    return sheet


def pins_and_loads() -> Sheet:
    """A sketch's board: rows on pins, columns on analog pins with a load each, without names of nets."""
    sheet = Sheet()
    rows, columns = [f"Net-(A1-D{k})" for k in range(2, 6)], [f"Net-(A1-A{k})" for k in range(5)]
    sheet.connector("J1", [*rows, *columns])
    for k, net in enumerate(columns):
        sheet.add(f"R{k + 1}", "1k", "R_US", {"1": net, "2": "GND"})
    uno = {str(k): net for k, net in enumerate([*rows, *columns, "+5V", "GND"], start=1)}
    sheet.add("A1", "Arduino_UNO_R3", "Arduino_UNO_R3", uno)
    return sheet


@pytest.mark.parametrize("xml", [False, True])
def test_two_multiplexers(tmp_path: Path, xml: bool) -> None:
    found = two_multiplexers().imported(tmp_path, xml=xml)
    design = found.design()
    assert design.array.shape == (16, 16)
    assert (design.readout.circuit, design.readout.columns) == ("voltage-divider", "multiplexed")
    assert design.readout.reference_resistance == 4700.0
    assert design.spreads["readout.reference_resistance"].tolerance == 0.01
    assert (design.drive.voltage, design.drive.idle_rows) == (5.0, "float")
    assert (design.array.row_lead, design.array.column_lead) == (70.0, 70.0)
    assert design.adc is not None
    assert design.adc.bits == 10
    assert len(found.questions) <= 5
    assert "# R1 4k7" in found.toml()
    volts = scan(design, np.full((16, 16), 1e4)).volts
    assert ((volts > 0.5) & (volts < 4.5)).all()


def test_shift_registers_and_amplifiers(tmp_path: Path) -> None:
    """The idle level, ground, is not the reference: only a described end of the rows says that."""
    found = shift_registers_and_amplifiers().imported(tmp_path)
    readout = found.tables["readout"]
    assert (readout["circuit"], readout["reference_resistance"]) == ("inverting-amplifier", 10e3)
    assert readout["reference_voltage"] == pytest.approx(1.65)
    assert (readout["gain_bandwidth"], readout["feedback_capacitance"]) == (1e6, pytest.approx(100e-12))
    assert readout["supply"] == pytest.approx([0.025, 3.275])
    assert (found.tables["array"]["rows"], found.tables["array"]["columns"]) == (8, 4)
    assert found.tables["row_end"]["selected"] == ["V1 drive 0 3.3", "R1 drive line 50"]
    assert found.tables["row_end"]["idle"] == ["V1 hold 0 0", "R1 hold line 50"]
    assert found.tables["adc"]["bits"] == 12
    assert "row_lead" not in found.tables["array"]
    assert found.design().array.shape == (8, 4)


def test_pins_and_loads(tmp_path: Path) -> None:
    found = pins_and_loads().imported(tmp_path)
    design = found.design()
    assert design.array.shape == (4, 5)
    assert design.readout.reference_resistance == 1e3
    assert (design.drive.voltage, design.drive.idle_rows) == (5.0, "ground")
    assert ("drive", "idle_rows") in found.questions
    assert len(found.questions) <= 5


def test_loads_to_the_supply_are_read_against_it(tmp_path: Path) -> None:
    sheet = pins_and_loads()
    for k in range(5):
        sheet.add(f"R{k + 1}", "1k", "R_US", {"1": f"Net-(A1-A{k})", "2": "+5V"})
    design = sheet.imported(tmp_path).design()
    assert (design.readout.reference_voltage, design.drive.voltage) == (5.0, -5.0)
    open_cells = scan(design, np.full((4, 5), math.inf)).volts
    np.testing.assert_allclose(open_cells, 5.0)


def test_diodes_in_rows(tmp_path: Path) -> None:
    sheet = pins_and_loads()
    uno = sheet.parts["A1"][2]
    for k in range(4):
        sheet.add(f"D{k + 1}", "1N4148", "D", {"1": f"Net-(A1-D{k + 2})", "2": f"/PIN{k}"})  # pin 1 is the cathode
        uno[str(k + 1)] = f"/PIN{k}"
    found = sheet.imported(tmp_path)
    assert found.tables["row_end"] == {"selected": ["V1 drive 0 5", "D1 drive node", "R1 node line 25"], "idle": []}
    assert "drive" not in found.tables


def test_pull_downs_of_open_rows(tmp_path: Path) -> None:
    sheet = two_multiplexers()
    for k in range(16):
        sheet.add(f"R{k + 10}", "22k", "R", {"1": f"/ROW{k}", "2": "GND"})
    design = sheet.imported(tmp_path).design()
    assert (design.drive.idle_rows, design.drive.idle_row_resistance) == ("pull", 22e3)


def test_cells_that_are_drawn_one_by_one(tmp_path: Path) -> None:
    sheet = pins_and_loads()
    del sheet.parts["J1"]
    for i in range(4):
        for j in range(5):
            sheet.add(f"RS{i}{j}", "FSR", "R_Variable", {"1": f"Net-(A1-D{i + 2})", "2": f"Net-(A1-A{j})"})
    design = sheet.imported(tmp_path).design()
    assert design.array.shape == (4, 5)
    assert design.readout.reference_resistance == 1e3


def test_roles_say_what_connectors_are(tmp_path: Path) -> None:
    """Without them nothing tells which pins without parts are lines."""
    sheet = Sheet()
    sheet.connector("J7", ["/X1", "/X2", "/X3"], Ohmskin_role="rows")
    sheet.connector("J8", ["/Y1", "/Y2"], Ohmskin_role="columns")
    found = sheet.imported(tmp_path)
    assert found.design().array.shape == (3, 2)
    assert {("readout", "reference_resistance"), ("drive", "voltage"), ("adc", "bits")} <= found.questions.keys()
    sheet.parts["J8"][3].clear()
    with pytest.raises(InputError, match=r"0 rows and 0 columns found.*Ohmskin.role"):
        sheet.imported(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no netlist of KiCad"),
        ("(export (components (comp (ref R1)", "is no s-expression"),
        ("(export " + "(" * 5000 + ")" * 5001, "no components or no nets"),
        ("<export><components>", "is no XML"),
        ("<board/>", "is no netlist of KiCad"),
        ("(export (components (comp (ref R1) (value 1k))))", "no components or no nets"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "other.net"
    file.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_netlist(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_names_of_parts_cannot_write_keys(tmp_path: Path) -> None:
    sheet = pins_and_loads()
    for k in range(5):
        sheet.add(f"R{k + 1}", "1k\n[adc]\nbits = 3", "R_US", {"1": f"Net-(A1-A{k})", "2": "GND"})
    found = sheet.imported(tmp_path)
    written = tmp_path / "design.toml"
    written.write_text(found.toml())
    assert differences(Design.load(written), found.design()) == []


DESIGNS = [ROOT / "verification" / "prototype.toml", *sorted((ROOT / "examples").glob("board-*x*.toml"))]


@pytest.mark.parametrize("path", [*DESIGNS, ROOT / "examples" / "toleranced.toml"], ids=lambda path: path.name)
def test_a_design_comes_back_from_its_netlist(tmp_path: Path, path: Path) -> None:
    netlist, back = tmp_path / "board.net", tmp_path / "back.toml"
    assert run(["netlist", str(path), "--kicad", "-o", str(netlist)]) == 0
    assert run(["import", str(netlist), "-o", str(back)]) == 0
    assert differences(Design.load(back), Design.load(path)) == []
    assert "\n# ?" not in back.read_text()
    assert "R1" in (tmp_path / "board.parts.csv").read_text()


def test_a_changed_board_differs_value_by_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, netlist = ROOT / "verification" / "prototype.toml", tmp_path / "board.net"
    netlist.write_text(to_netlist(read_toml(path)).replace('(value "20k")', '(value "22k")'))
    assert run(["import", str(netlist), "--against", str(path)]) == 1
    assert capsys.readouterr().out == "readout.reference_resistance: 22000.0 in the netlist, 20000.0 in the design\n"


ohms = st.floats(1.0, 1e7)


@given(
    shape=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    circuit=st.sampled_from(["inverting-amplifier", "row-amplifier", "voltage-divider", "voltage-feedback"]),
    load=ohms,
    lead=st.one_of(st.just(0.0), ohms),
    volts=st.floats(-5.0, 5.0).filter(lambda v: abs(v) > 0.1),
    level=st.floats(0.0, 5.0),
    multiplexed=st.booleans(),
    pull=st.one_of(st.none(), ohms),
    tolerance=st.one_of(st.none(), st.floats(0.001, 0.5)),
)
def test_any_design_comes_back(
    shape: tuple[int, int],
    circuit: str,
    load: float,
    lead: float,
    volts: float,
    level: float,
    multiplexed: bool,
    pull: float | None,
    tolerance: float | None,
) -> None:
    drives_itself = circuit == "voltage-feedback"
    readout: dict[str, Any] = {"circuit": circuit, "reference_voltage": level}
    readout["reference_resistance"] = load if tolerance is None else {"nominal": load, "tolerance": tolerance}
    drive: dict[str, Any] = {"voltage": volts}
    if multiplexed and not drives_itself:
        readout["columns"] = "multiplexed"
    if pull is not None and not drives_itself:
        drive |= {"idle_rows": "pull", "idle_row_resistance": pull}
    tables = {"array": {"rows": shape[0], "columns": shape[1], "row_lead": lead}, "drive": drive, "readout": readout}
    design = parse(tables, Design, source="here")
    found = import_design(parse_netlist(to_netlist(tables), "here"))
    assert differences(found.design(), design) == []
    assert not found.questions


def _layout(cells: list[tuple[int, int, float, float, float]], **nets: str) -> str:
    """A layout with cells (row, column, x, y, angle): combs of 2 x 6 mm, 4 mm apart, between a row and a column."""
    row_net, column_net = nets.get("row", "/skin/ROW{}"), nets.get("column", "COL{}")
    parts = "".join(
        f'(footprint "skin:comb" (layer "F.Cu") (at {x} {y} {angle}) (property "Reference" "S{row}_{column}")'
        f'(pad "1" smd rect (at -2 0 {angle}) (size 2 6) (layers "F.Cu") (net 1 "{row_net.format(row)}"))'
        f'(pad "2" smd rect (at 2 0 {angle}) (size 2 6) (layers "F.Cu") (net 2 "{column_net.format(column)}")))'
        for row, column, x, y, angle in cells
    )
    resistor = '(footprint "R" (at 1 2) (pad "1" smd rect (at 0 0) (size 1 1) (net 1 "/skin/ROW1")))'
    return f'(kicad_pcb (version 20240108) (net 1 "GND") {resistor}{parts})'


def test_the_pads_of_a_layout_are_the_places_of_the_cells(tmp_path: Path) -> None:
    layout = tmp_path / "skin.kicad_pcb"
    layout.write_text(_layout([(1, 1, 100, 50, 0), (1, 2, 109.5, 50, 90), (2, 2, 109.5, 61.25, 30)]))
    shape = shape_of_layout(layout)
    assert (shape.row, shape.column) == ((0, 0, 1), (0, 1, 1))
    assert (shape.x_mm, shape.y_mm) == ((100.0, 109.5, 109.5), (50.0, 50.0, 61.25))
    assert shape.area_mm2 == (36.0, 36.0, 36.0)


def test_a_footprint_that_is_turned_turns_its_pads(tmp_path: Path) -> None:
    """KiCad turns against the clock, with y down: a pad to the right of a part at 90 degrees lies above it."""
    layout = tmp_path / "skin.kicad_pcb"
    both = '(net 1 "ROW0")) (pad "2" smd rect (at 11 0 {0}) (size 2 4) (net 2 "COL0")))'
    part = '(footprint "skin" (at 20 30 {0}) (pad "1" smd rect (at 9 0 {0}) (size 2 4) ' + both
    layout.write_text(f"(kicad_pcb {part.format(90)})")
    shape = shape_of_layout(layout)
    assert (shape.x_mm[0], shape.y_mm[0]) == pytest.approx((20.0, 20.0))
    assert shape.area_mm2 == pytest.approx((16.0,))


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("(export)", {}, "is no layout of KiCad"),
        (_layout([]), {}, "no footprint lies between nets"),
        (_layout([(0, 0, 1, 1, 0), (0, 0, 9, 1, 0)]), {}, r"cell \(0, 0\) is there twice"),
        (_layout([(0, 0, 1, 1, 0)]), {"rows": "ROW"}, "expected one group each"),
        (_layout([(0, 0, 1, 1, 0)]), {"rows": "ROW("}, "no regular expression"),
        *(
            (_layout([(0, 0, 1, 1, 0)]).replace("(size 2 6)", f"(size {size})"), {}, "expected 2 numbers")
            for size in ("2", "2 6 36 90", "2 6 (x)", "2 nan", "")
        ),
        (_layout([(0, 0, 1, 1, 0)]).replace("(at 1 1 0)", "(at 1 1 0 9)"), {}, "expected 2 or 3 numbers"),
        (_layout([(0, 0, 1, 1, 0)], row="ROW{}" + "9" * 5000), {}, "has no number of a line"),
        (_layout([(0, 0, 1, 1, 0)]), {"rows": "(ROW).*"}, "has no number of a line"),
        (_layout([(0, 0, 1, 1, 0)]), {"rows": "(x)?ROW.*"}, "has no number of a line"),
    ],
)
def test_a_layout_without_cells_is_refused(tmp_path: Path, text: str, options: dict[str, str], message: str) -> None:
    (tmp_path / "skin.kicad_pcb").write_text(text)
    with pytest.raises(InputError, match=f"skin.kicad_pcb: .*{message}"):
        shape_of_layout(tmp_path / "skin.kicad_pcb", **options)
