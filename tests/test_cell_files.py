"""Files as people have them: whatever the columns, units, clocks and circuits, the same cell is read from them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cells import EXAMPLE, FULL, sense
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.cell import Cell, Layout, Role, load_recording, read_files
from ohmskin.cell.identification._units import header_unit
from ohmskin.emulator import LinkFault
from ohmskin.errors import InputError

DT = 0.1
TIME = DT * np.arange(1200.0)
LOAD = np.clip(np.sin(TIME / 4) * np.sin(TIME / 11), 0, None) * (TIME > 3)
OHM = sense(EXAMPLE, LOAD)
AREA_MM2 = 100.0
NEWTON = FULL * LOAD * AREA_MM2 / 1e3


def write(path: Path, header: str, *columns: object, separator: str = ",") -> Path:
    rows = zip(*(np.asarray(column).tolist() for column in columns), strict=True)
    body = "".join(separator.join(str(value) for value in row) + "\n" for row in rows)
    path.write_text((header + "\n" if header else "") + body)
    return path


def same(paths: list[Path], layout: Layout, tolerance: float = 1e-6) -> None:
    found = load_recording(paths, layout, trust_units=True)
    assert found.time_s == pytest.approx(TIME, abs=1e-6)
    assert found.pressure_kpa == pytest.approx(FULL * LOAD, abs=tolerance * FULL)
    assert found.resistance_ohm == pytest.approx(OHM, rel=tolerance)


@pytest.mark.parametrize(
    ("header", "factors"),
    [
        ("Time (s),Load (lbf),Resistance (kOhm)", (1.0, 1 / 4.4482216, 1e-3)),
        ("time_ms,force_N,R [ohm]", (1e3, 1.0, 1.0)),
        ("t/us,Fz mN,resistance_Mohm", (1e6, 1e3, 1e-6)),
        ("Time [min],Weight (g),G (uS)", (1 / 60, 1 / 9.80665e-3, None)),
    ],
)
def test_units_in_headers_are_taken(header: str, factors: tuple[float, float, float | None], tmp_path: Path) -> None:
    time, force, ohm = factors
    reading = 1e6 / OHM if ohm is None else OHM * ohm
    file = write(tmp_path / "f.csv", header, TIME * time, NEWTON * force, reading)
    same([file], Layout(area_mm2=AREA_MM2))
    with pytest.raises(InputError, match="a force; --area MM2 makes it a pressure"):
        load_recording([file])


@given(
    name=st.from_regex(r"[A-Z][a-z]{2,8}", fullmatch=True),
    unit=st.sampled_from(["kPa", "psi", "N", "lbf", "ms", "kOhm", "mV", "uS", "counts"]),
    form=st.sampled_from(["{} ({})", "{} [{}]", "{}_{}", "{} {}", "{}/{}"]),
)
def test_the_unit_of_a_header_is_read_in_every_form(name: str, unit: str, form: str) -> None:
    stem, found = header_unit(form.format(name, unit))
    assert (stem, found and found.name.lower()) == (name, unit.lower())


def test_a_guess_is_said_and_has_to_be_confirmed(tmp_path: Path) -> None:
    file = write(tmp_path / "f.csv", "Time,Pressure,R", TIME, FULL * LOAD, OHM)
    with pytest.raises(
        InputError, match="guessed: time is 'Time' in s; load is 'Pressure' in kPa; reading is 'R' in ohm"
    ):
        load_recording([file])
    said: list[str] = []
    load_recording([file], Layout(as_guessed=True), note=said.append)
    assert "guessed" in said[0]
    same([file], Layout(columns={"time": "Time:s", "load": "Pressure:kPa", "reading": "3:ohm"}))


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_a_file_without_a_header_has_columns_in_order(separator: str, tmp_path: Path) -> None:
    file = write(tmp_path / "f.csv", "", TIME, FULL * LOAD, OHM, separator=separator)
    with pytest.raises(InputError, match="guessed: time is '1' in s; load is '2' in kPa"):
        load_recording([file])
    same([file], Layout(as_guessed=True))


def test_one_of_several_cells_has_to_be_named(tmp_path: Path) -> None:
    wide = write(tmp_path / "w.csv", "time_s,force_N,R1 (ohm),R2 (ohm)", TIME, NEWTON, 2 * OHM, OHM)
    with pytest.raises(InputError, match=r"the reading may be 'R1 \(ohm\)', 'R2 \(ohm\)'; --column reading=NAME"):
        load_recording([wide], Layout(area_mm2=AREA_MM2))
    same([wide], Layout(area_mm2=AREA_MM2, columns={"reading": "R2"}))
    cell = np.tile(["left", "right"], len(TIME))
    both = np.stack([2 * OHM, OHM], axis=1).ravel()
    long = write(tmp_path / "l.csv", "time_s,pad,force_N,R (ohm)", np.repeat(TIME, 2), cell, np.repeat(NEWTON, 2), both)
    columns: dict[Role, str] = {"cell": "pad"}
    with pytest.raises(InputError, match="column 'pad' has left, right; --only VALUE"):
        load_recording([long], Layout(area_mm2=AREA_MM2, columns=columns))
    same([long], Layout(area_mm2=AREA_MM2, columns=columns, only="right"))


@pytest.mark.parametrize("counts", [None, 4095.0])
def test_volts_and_counts_of_a_divider_become_ohms(counts: float | None, tmp_path: Path) -> None:
    share = 10e3 / (10e3 + OHM)
    file = write(tmp_path / "f.csv", "time_s,pressure_kpa,out (V)" if counts is None else "time_s,pressure_kpa,adc",
                 TIME, FULL * LOAD, 3.3 * share if counts is None else np.round(4095 * share, 9))  # fmt: skip
    columns: dict[Role, str] = {"reading": "3:V" if counts is None else "adc:counts"}
    with pytest.raises(InputError, match="--divider OHM --supply V make it a resistance"):
        load_recording([file], Layout(columns=columns))
    same([file], Layout(columns=columns, divider_ohm=10e3, supply_v=3.3, counts=counts))
    if counts is not None:
        with pytest.raises(InputError, match=r"how many are the supply.*4095 is guessed"):
            load_recording([file], Layout(columns=columns, divider_ohm=10e3, supply_v=3.3))


@pytest.mark.parametrize("late_s", [0.0, 1.7, -1.2])
@pytest.mark.parametrize("offset_s", [0.0, 1.6e9])
def test_two_clocks_are_put_together(late_s: float, offset_s: float, tmp_path: Path) -> None:
    """The load at 37 samples a second of a clock of its own."""
    at = np.arange(0, 119, 1 / 37)
    load = write(tmp_path / "gauge.csv", "t (s),Load (N)", at + late_s + offset_s, np.interp(at, TIME, NEWTON))
    reading = write(tmp_path / "board.csv", "time_ms,R (ohm)", 1e3 * TIME, OHM)
    if offset_s:
        with pytest.raises(InputError, match=r"hardly overlap.*--align starts both at once"):
            load_recording([load, reading], Layout(area_mm2=AREA_MM2))
    elif late_s:
        apart = load_recording([load, reading], Layout(area_mm2=AREA_MM2))
        assert np.std(apart.pressure_kpa - FULL * np.interp(apart.time_s, TIME, LOAD)) > 0.05 * FULL
    found = load_recording([reading, load], Layout(area_mm2=AREA_MM2, align=True))
    assert np.std(found.pressure_kpa - FULL * np.interp(found.time_s, TIME, LOAD)) < 0.04 * FULL


def test_an_estimate_needs_no_load(tmp_path: Path) -> None:
    file = write(tmp_path / "f.csv", "time_ms,R (kOhm)", 1e3 * TIME, OHM / 1e3)
    found = read_files([file], Layout(), roles=("time", "reading"))
    assert set(found) == {"time_s", "resistance_ohm"}
    assert found["resistance_ohm"] == pytest.approx(OHM)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (lambda: (TIME, FULL * LOAD, np.round(1000 * 10e3 / (10e3 + OHM))), "are they counts of a converter"),
        (lambda: (TIME, 5026 * LOAD, OHM), "reaches 4.*is it in Pa, or a force"),
    ],
)
def test_impossible_units_are_asked_about(
    columns: Callable[[], tuple[np.ndarray, ...]], message: str, tmp_path: Path
) -> None:
    file = write(tmp_path / "f.csv", "time_s,pressure_kpa,resistance_ohm", *columns())
    with pytest.raises(InputError, match=message):
        load_recording([file])
    load_recording([file], trust_units=True)


@pytest.mark.parametrize(
    ("column", "message"),
    [("force", "no column 'force'"), ("9", "no column '9'"), ("R:N", "is in N, which is no unit of a reading")],
)
def test_a_column_that_is_not_there_is_said(column: str, message: str, tmp_path: Path) -> None:
    file = write(tmp_path / "f.csv", "time_s,pressure_kpa,R (ohm)", TIME, FULL * LOAD, OHM)
    with pytest.raises(InputError, match=message):
        load_recording([file], Layout(columns={"reading": column}))


# CELL.toml: what is accepted, and one clear line for what is not


GOOD = """
rest_resistance_ohm = 1e4
full_scale_kpa = 15.5
[model]
kind = "asymmetric"
e1_kpa = 32
e2_kpa = 60
e3_kpa = 480
eta2_kpa_s = 510
eta3_kpa_s = 48000
"""


def load(tmp_path: Path, text: str) -> Cell:
    path = tmp_path / "cell.toml"
    path.write_text(text, encoding="utf-8")
    return Cell.load(path)


def test_a_good_cell_loads(tmp_path: Path) -> None:
    assert load(tmp_path, GOOD).model.kind == "asymmetric"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[model]",
            "full_scal = 1\n[model]",
            "unknown key 'full_scal'; the nearest known key, 'full_scale_kpa', is there already",
        ),
        (
            "[model]",
            "[model]\neta2 = 510",
            "unknown key 'model.asymmetric.eta2'; the nearest known key, 'eta2_kpa_s', is there already",
        ),
        (
            "eta2_kpa_s = 510",
            "eta2 = 510",
            "unknown key 'model.asymmetric.eta2'; the nearest known key is 'eta2_kpa_s'",
        ),
        ("rest_resistance_ohm = 1e4", "rest_resistance_ohm = -1", "rest_resistance_ohm"),
        ("eta2_kpa_s = 510", "", "missing key 'model.asymmetric.eta2_kpa_s'"),
        (
            '"asymmetric"',
            '"burgers"',
            "cell.toml: model.kind: input should be 'paper', 'asymmetric', 'm10' or 'contact' (got 'burgers')",
        ),
        ('"asymmetric"', "3", "model.kind: input should be 'paper', 'asymmetric', 'm10' or 'contact' (got '3')"),
        ('kind = "asymmetric"', "", "cell.toml: missing key 'model.kind'"),
        ("eta2_kpa_s = 510", "eta2_kpa_s = nan", "model.asymmetric.eta2_kpa_s"),
        ("eta2_kpa_s = 510", "eta2_kpa_s = 5100000", "the third branch must be the slower"),
    ],
)
def test_a_bad_cell_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, GOOD.replace(old, new))
    assert "cell.toml" in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_of_something_else_is_refused() -> None:
    with pytest.raises(InputError, match=r"model\.kind: input should be .* \(got 'stall'\)"):
        Cell.example().replace(model=LinkFault(kind="stall", at_s=1.0))


def test_phases_that_disagree_at_equilibrium_are_refused() -> None:
    cell = Cell.example()
    tables = cell.model_dump()
    tables["model"]["eu1_kpa"] = 25.0
    with pytest.raises(ValueError, match="1/Eu1"):
        Cell.model_validate(tables)
