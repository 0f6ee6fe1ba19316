"""A maker's macro-model in the netlist: against an independent nodal analysis, and files that must be refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from needs import need
from scipy.optimize import brentq
from verified import AMPLIFIED, complete

from ohmskin.circuits import AmplifierModel, Design, Requirement, scan, spice, stability
from ohmskin.cli import run
from ohmskin.common.config import parse
from ohmskin.errors import InputError, SolverError
from ohmskin.verification import Report, verify

GAIN, GBW, SECOND_POLE = 2e5, 1e6, 1.5e6
INPUT_OHM, INPUT_FARAD, OUTPUT_OHM = 10e6, 8e-12, 300.0
MODEL = f"""* an amplifier of two poles with real input and output impedances; caf\xe9 \xb5
.SUBCKT TWOPOLE INP INN VCC VEE OUT PARAMS: A0={GAIN!r}
+ GBW={GBW!r} ; a comment
Rin INP INN {INPUT_OHM!r}
Cin INN 0 {INPUT_FARAD!r}
G1 0 P INP INN {{A0}}
R1 P 0 1
C1 P 0 {{A0/(6.283185307179586*GBW)}}
X1 P B FOLLOWER
RO B OUT {OUTPUT_OHM!r}
Rquiet VCC VEE 1Meg
.ENDS TWOPOLE
.SUBCKT FOLLOWER IN OUT
G2 0 Q IN 0 1
R2 Q 0 1
C2 Q 0 {1 / (2 * np.pi * SECOND_POLE)!r}
E1 OUT 0 Q 0 1
.ENDS
.END
"""
CELLS = np.array([[17e3, 10e3, 12e3], [9e3, 17e3, 10e3], [10e3, 14e3, 11e3]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "opa.lib").write_bytes(MODEL.encode("latin-1"))
    return tmp_path


def _design(folder: Path, model: str = 'file = "opa.lib", subcircuit = "twopole"', **readout: object) -> Design:
    text = complete(AMPLIFIED.replace("supply = [0.0, 3.3]", f"supply = [-5.0, 5.0]\namplifier_model = {{ {model} }}"))
    (folder / "design.toml").write_text(text)
    design = Design.load(folder / "design.toml")
    return design.replace(readout={"offset_voltage": 0.0, "feedback_capacitance": 2e-12} | readout)


def _return_ratio(design: Design, cells: np.ndarray, column: int, hertz: float) -> complex:
    """The loop gain of one amplifier by nodal analysis: its controlled source replaced by 1 V, the others alive.

    Unknowns: the crosspoints of rows (ideal columns have none of their own), and input and output of each amplifier.
    """
    s = 2j * np.pi * hertz
    rows, columns = cells.shape
    readout = design.readout
    reference, lead = float(np.max(readout.reference_resistance)), float(np.max(design.array.row_lead))
    gain = 1 / (1 / GAIN + s / (2 * np.pi * GBW)) / (1 + s / (2 * np.pi * SECOND_POLE))
    size = rows + 2 * columns
    matrix, source = np.zeros((size, size), dtype=complex), np.zeros(size, dtype=complex)

    def join(a: int, b: int | None, siemens: complex) -> None:
        matrix[a, a] += siemens
        if b is not None:
            matrix[b, b] += siemens
            matrix[a, b] -= siemens
            matrix[b, a] -= siemens

    for i in range(rows):
        join(i, None, 1 / lead)
    for i, j in np.ndindex(cells.shape):
        join(i, rows + j, 1 / cells[i, j])
    for j in range(columns):
        minus, out = rows + j, rows + columns + j
        join(minus, out, 1 / reference + s * readout.feedback_capacitance)
        join(minus, None, s * (readout.column_capacitance + INPUT_FARAD) + 1 / INPUT_OHM)
        join(out, None, 1 / OUTPUT_OHM)
        if j == column:
            source[out] += 1 / OUTPUT_OHM
        else:
            matrix[out, minus] += gain / OUTPUT_OHM
    answer = np.linalg.solve(matrix, source)
    return complex(gain * answer[rows + column])


@pytest.mark.parametrize("column", [0, 2])
@pytest.mark.parametrize("column_capacitance", [100e-12, 1e-9])
def test_the_phase_margin_is_that_of_an_independent_analysis(
    folder: Path, column: int, column_capacitance: float
) -> None:
    need(spice.command_available())
    design = _design(folder, column_capacitance=column_capacitance)
    crossover = brentq(lambda hz: abs(_return_ratio(design, CELLS, column, hz)) - 1, 1e3, 1e7)
    margin = 180 + np.degrees(np.angle(_return_ratio(design, CELLS, column, crossover)))
    found = spice.dynamic_reading(design, CELLS, 1, column=column)
    assert found.crossover == pytest.approx(crossover, rel=2e-3)
    assert found.phase_margin == pytest.approx(margin, abs=0.2)
    # The second pole takes what the one-pole analysis promises.
    assert found.phase_margin < stability(design, CELLS).phase_margin[1, column] - 2
    # The model has the same gain at DC, so it settles to the same readings.
    signal = scan(design, CELLS).volts[1]
    np.testing.assert_allclose(found.settled, signal, atol=1e-3 * np.abs(signal).max())


def test_pins_go_where_the_design_says(folder: Path) -> None:
    need(spice.command_available())
    other = MODEL.replace("INP INN VCC VEE OUT PARAMS:", "OUT VEE NC INN INP VCC GND PARAMS:").replace("\xe9", "e")
    (folder / "opa.lib").write_text(other.replace("\xb5", "u"))
    pins = '["out", "v-", "open", "in-", "in+", "v+", "ground"]'
    design = _design(folder, f'file = "opa.lib", subcircuit = "TWOPOLE", pins = {pins}')
    found = spice.dynamic_reading(design, CELLS, 0)
    np.testing.assert_allclose(found.settled, scan(design, CELLS).volts[0], rtol=1e-3)
    text = spice.dynamic_netlist(design, CELLS, 0)
    assert "Xamplifier1 out1 rail_low open1_2 minus1 ref rail_high 0 TWOPOLE" in text
    assert "Vhigh rail_high 0 DC 5.0" in text


def test_a_model_in_the_dialect_of_pspice_runs(folder: Path) -> None:
    need(spice.command_available())
    limited = "G1 0 P VALUE={LIMIT(IF(V(INP,INN)>0, A0*V(INP,INN), A0*V(INP,INN)), -1e6, 1e6)}"
    margins = []
    for text in (MODEL, MODEL.replace("G1 0 P INP INN {A0}", limited)):
        (folder / "opa.lib").write_bytes(text.encode("latin-1"))
        margins.append(spice.dynamic_reading(_design(folder), CELLS, 0).phase_margin)
    assert margins[1] == pytest.approx(margins[0], abs=0.05)


def test_a_board_that_the_model_finds_unstable_fails(folder: Path) -> None:
    """The one-pole analysis cannot know: a second pole below the crossover, and a resistor behind the output."""
    need(spice.command_available())
    slow = MODEL.replace(f"{1 / (2 * np.pi * SECOND_POLE)!r}", f"{1 / (2 * np.pi * 2e4)!r}")
    (folder / "opa.lib").write_bytes(slow.encode("latin-1"))
    asked = [Requirement(id=method, quantity="phase_margin", min=45.0, method=method) for method in METHODS]
    report = verify(_design(folder), requirements=asked)
    assert {result.requirement.id: str(result.outcome) for result in report.results} == dict(
        zip(METHODS, ("pass", "fail"), strict=True)
    )


METHODS = ("worst-case", "spice")
HOSTILE = [
    (".control\nshell touch hacked\n.endc", "line 2: '.control' is not part of a model"),
    (".CONTROL\nshell touch hacked\n.ENDC", "line 2: '.CONTROL' is not part of a model"),
    ("  \t.control", "is not part of a model"),
    ("*# shell touch hacked", "is a command to ngspice"),
    ("  *#shell touch hacked", "is a command to ngspice"),
    (".include /etc/passwd", "line 2: '.include /etc/passwd' is not part of a model"),
    (".lib 'other.lib' TT", "is not part of a model"),
    (".csparam x=1", "is not part of a model"),
    (".tran 1n 1", "is not part of a model"),
    (".print tran v(1)", "is not part of a model"),
    ("Vsteal drive 0 5", "stands outside a .SUBCKT"),
    (".subckt FOLLOWER 1 2\nA1 [1] [2] reader\n.ends", "or a code model"),
    (".subckt S 1 2\nA1 [1] [2] reader\n.ends", None),
    (".model reader filesource(file=/etc/passwd)", "unknown type of model"),
    (".subckt FOLLOWER 1 2\nV1 1 2 PWL FILE=/etc/passwd\n.ends", "would read a file"),
    (".subckt S 1 2\nV1 1 2 PWL FILE=/etc/passwd\n.ends", None),
    (".param x={`touch hacked`}", "expected plain ASCII"),
    (".param \u03bc=1", "expected plain ASCII"),
    (".subckt S 1 2\nX1 1 2 S\n.ends", None),
    (".subckt S 1 2", "has no .ENDS"),
    (".ends", ".ENDS without .SUBCKT"),
    (".func= f(x) {x}", "is not part of a model"),
    ("$CDNENCSTART_ADV2", "the model is encrypted"),
]


@pytest.mark.parametrize(("line", "message"), HOSTILE)
def test_what_is_no_circuit_is_refused(line: str, message: str | None, folder: Path) -> None:
    (folder / "opa.lib").write_text(f"* model\n{line}\n" + MODEL.replace("\xe9", "").replace("\xb5", ""))
    if message is None:  # a subcircuit that the design does not use, and that does not get into the netlist
        model = _design(folder).readout.amplifier_model
        assert model is not None
        assert ".subckt S" not in model.text
        return
    with pytest.raises(InputError) as caught:
        _design(folder)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ('file = "nowhere.lib", subcircuit = "TWOPOLE"', "nowhere.lib: cannot be read"),
        ('file = "opa.lib", subcircuit = "OPA"', "no .SUBCKT OPA; the file has follower, twopole"),
        ('file = "opa.lib", subcircuit = "FOLLOWER"', "FOLLOWER has 2 pins (in out), but"),
        ('file = "opa.lib", subcircuit = "TWOPOLE", pins = ["in+", "out", "v+", "v-", "ground"]', "name 'in-' once"),
        ('file = "opa.lib", subcircuit = "TWOPOLE", pins = ["plus", "out"]', "readout.amplifier_model.pins"),
        ('file = "opa.lib", subcircuit = "T\\n.control"', "readout.amplifier_model.subcircuit"),
        ('file = "opa.lib"', "missing key 'readout.amplifier_model.subcircuit'"),
        ('file = "opa.lib", subcircuit = "TWOPOLE", rails = [5.0, 0.0]', "rails must be"),
    ],
)
def test_a_model_that_does_not_fit_is_one_line(
    model: str, message: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError) as caught:
        _design(folder, model)
    assert message in str(caught.value)
    assert run(["verify", str(folder / "design.toml"), "-o", str(folder / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_model_that_contains_itself_is_refused(folder: Path) -> None:
    (folder / "opa.lib").write_text(".SUBCKT A 1 2 3 4 5\nX1 1 2 B\n.ENDS\n.SUBCKT B 1 2\nX1 1 2 3 4 5 A\n.ENDS\n")
    with pytest.raises(InputError, match="contains itself"):
        _design(folder, 'file = "opa.lib", subcircuit = "A"')


@pytest.mark.parametrize(("depth", "fan"), [(5, 10), (40, 2), (1500, 3)])
def test_a_model_that_grows_without_end_is_refused_before_it_runs(depth: int, fan: int, folder: Path) -> None:
    """1.2 kB of nested subcircuits would take ngspice gigabytes."""
    head = ".SUBCKT OPA INP INN VCC VEE OUT\nE1 OUT 0 INP INN 1e5\nX1 INP L0\n.ENDS\n"
    calls = {d: "".join(f"X{k} A L{d + 1}\n" for k in range(fan)) for d in range(depth)} | {depth: "R1 A 0 1e9\n"}
    levels = [f".SUBCKT L{d} A\n{body}.ENDS\n" for d, body in calls.items()]
    (folder / "opa.lib").write_text(head + "".join(levels))
    with pytest.raises(InputError, match="statements; expected at most 20000"):
        _design(folder, 'file = "opa.lib", subcircuit = "OPA"')
    (folder / "opa.lib").write_text(head + "".join(levels[-3:]).replace(f"L{depth - 2}", "L0"))
    assert _design(folder, 'file = "opa.lib", subcircuit = "OPA"').readout.amplifier_model is not None


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (".FUNC F(X) {X+X}\nBX Q 0 V={" + 40 * "F(" + "1" + 40 * ")" + "}\nRX Q 0 1", "of memory"),
        ("BX X 0 V={SIN(6.28e12*TIME)}\nRX X Y 1k\nCX Y 0 1p", "of memory|s of processor time"),
    ],
)
def test_a_model_decides_neither_memory_nor_time(
    more: str, said: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(spice.command_available())
    monkeypatch.setattr("ohmskin.circuits.spice._ngspice.MOST_MEMORY", 2**28)
    monkeypatch.setattr("ohmskin.circuits.spice._ngspice.LEAST_LIMIT_S", 5)
    monkeypatch.setattr("ohmskin.circuits.spice._ngspice.LIMIT_PER_CARD_S", 0)
    (folder / "opa.lib").write_text(MODEL.replace("\xe9", "").replace("\xb5", "").replace("Rin", more + "\nRin", 1))
    with pytest.raises(SolverError, match=said):
        spice.dynamic_reading(_design(folder), CELLS, 0, period=1.0, analyses=["transient"])


def test_a_continuation_of_nothing_is_nothing(folder: Path) -> None:
    (folder / "opa.lib").write_bytes(b"+\n+ \n" + MODEL.encode("latin-1"))
    assert _design(folder).readout.amplifier_model is not None


def test_supply_pins_need_a_supply(folder: Path) -> None:
    design = _design(folder).replace(readout={"supply": (float("-inf"), float("inf"))})
    with pytest.raises(InputError, match="rails: not given"):
        spice.dynamic_netlist(design, CELLS, 0)
    rails = AmplifierModel(file=folder / "opa.lib", subcircuit="TWOPOLE", rails=(-2.5, 2.5))
    text = spice.dynamic_netlist(design.replace(readout={"amplifier_model": rails}), CELLS, 0)
    assert "Vlow rail_low 0 DC -2.5" in text


def test_a_model_that_ngspice_does_not_take_is_named(folder: Path) -> None:
    need(spice.command_available())
    (folder / "opa.lib").write_text(".SUBCKT TWOPOLE 1 2 3 4 5\nX1 1 2 NOWHERE\n.ENDS\n")
    with pytest.raises(SolverError, match="ngspice"):
        spice.dynamic_reading(_design(folder), CELLS, 0)


def _found(report: Report) -> dict[str, Any]:
    return {result.requirement.id: result for result in report.results}


def test_requirements_are_judged_by_the_model(folder: Path) -> None:
    need(spice.command_available())
    design = _design(folder)
    found = _found(verify(design, only=["D8", "D10", "D19", "D21", "D22"]))
    assert {str(result.outcome) for result in found.values()} == {"pass"}
    assert found["D21"].method == "spice"
    one_pole, model = (found[id].measurement for id in ("D10", "D21"))
    assert one_pole is not None
    assert model is not None
    assert model.value < one_pole.value - 2
    assert "macro-model twopole of opa.lib" in model.confidence


def test_spice_has_nothing_to_say_of_a_divider(folder: Path) -> None:
    asked = [Requirement(id="R1", quantity="phase_margin", min=45.0, method="spice")]
    (result,) = verify(_design(folder).with_circuit("voltage-divider"), requirements=asked).results
    assert str(result.outcome) == "does not apply"
    (result,) = verify(_design(folder).with_circuit("voltage-feedback"), requirements=asked).results
    assert str(result.outcome) == "not run"
    assert "dynamics are modelled for amplifiers" in result.reason


PUBLISHED = """* one pole of 1 MHz, gain 1e5, as makers write it
.MODEL QUIET RES(T_ABS=-273.15)
.MODEL WARM RES(R=1 {warm})
.SUBCKT AMP/X INP INN VCC VEE OUT
RIN INP INN 10Meg
E0 S0 0 INP INN 1
RS S0 S QUIET 10Meg
RW VCC VEE WARM 1Meg
G1 0 P S 0 0.1
R1 P 0 1Meg
C1 P 0 15.9155n
E1 B 0 P 0 1
RO B OUT 10
RQ VCC VEE 1Meg
{more}
.ENDS* next part
\x1a"""
"""A DOS end of file, text behind .ENDS, a slash in the name, and a resistor without noise."""


def _published(tmp_path: Path, *, warm: str = "", more: str = "") -> Design:
    (tmp_path / "amp.lib").write_text(PUBLISHED.format(warm=warm, more=more))
    model = parse({"file": "amp.lib", "subcircuit": "AMP/X"}, AmplifierModel, source="design", folder=tmp_path)
    return Design.model_validate(
        {
            "array": {"rows": 2, "columns": 2, "row_lead": 50.0},
            "drive": {"voltage": -0.5},
            "readout": {
                **{"circuit": "inverting-amplifier", "reference_resistance": 10e3, "reference_voltage": 1.5},
                **{"open_loop_gain": 1e5, "gain_bandwidth": 1e6, "supply": (0.0, 5.0), "column_capacitance": 100e-12},
                **{"feedback_capacitance": 10e-12, "temperature": 300.15, "amplifier_model": model},
            },
            "cells": {"rest_resistance": 10e3, "full_scale_resistance": 17.75e3},
            "operation": {"frame_rate": 50.0},
        }
    )


def _judged(design: Design) -> dict[str, Any]:
    limits = {"phase_margin": {"min": 45.0}, "settling_error": {"max": 1.0}, "noise": {"max": 1e-3}}
    asked = [Requirement.model_validate({"id": q, "quantity": q, "method": "spice"} | k) for q, k in limits.items()]
    return _found(verify(design, requirements=asked))


def test_a_published_model_is_taken_as_it_is(tmp_path: Path) -> None:
    need(spice.command_available())
    found = _judged(_published(tmp_path))
    assert {str(result.outcome) for result in found.values()} == {"pass"}
    noise = found["noise"].measurement
    assert noise is not None
    assert noise.value == pytest.approx(24.91e-6, rel=1e-3)


def test_parameters_that_the_simulator_drops_decide_nothing(tmp_path: Path) -> None:
    need(spice.command_available())
    for warm, name in (("T_ABS=25", "T_ABS"), ("VENDOR=3", "vendor")):
        result = _judged(_published(tmp_path, warm=warm))["noise"]
        assert str(result.outcome) == "not run"
        assert f"ngspice does not know {name}" in result.why
        assert result.measurement is not None
        assert result.measurement.value == pytest.approx(24.91e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("line", "word"),
    [("A1 0 P 0 0 0 0 OUT 0 OTA", "LTspice"), ("C9 P 0 1n Rpar=1Meg", "'Rpar'"), ("R9 P 0 1k noiseless", "noiseless")],
)
def test_dialects_that_ngspice_does_not_read_are_named_with_the_line(line: str, word: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"line 15: .*{word}"):
        _published(tmp_path, more=line)
