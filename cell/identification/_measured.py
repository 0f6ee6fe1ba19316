"""Recordings as people have them: any columns and units, two files with two clocks, volts or counts of a divider."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from ...common.arrays import FloatArray
from ...common.tables import LINE, Table
from ...errors import InputError
from ._recording import COLUMNS, Recording, checked_recording, unrepeated
from ._remarks import clock_shift_s
from ._units import Quantity, Unit, header_unit, unit_named

Role = Literal["time", "load", "reading", "cell"]
QUANTITIES: dict[Role, tuple[Quantity, ...]] = {
    "time": ("time",),
    "load": ("pressure", "force"),
    "reading": ("resistance", "conductance", "voltage", "counts"),
}
"""what a unit in a header says about the column"""
WORDS: dict[Role, dict[str, str]] = {
    "time": dict.fromkeys(("time", "t", "timestamp", "elapsed", "seconds", "date"), "s"),
    "load": {"pressure": "kPa", "stress": "kPa", "p": "kPa", **dict.fromkeys(("force", "load", "fz", "f"), "N")},
    "reading": {
        **dict.fromkeys(("resistance", "res", "r", "ohm"), "ohm"),
        **dict.fromkeys(("voltage", "vout", "v"), "V"),
        **dict.fromkeys(("adc", "raw", "counts", "analog", "fsr", "sensor", "value"), "counts"),
    },
}
"""names that are guessed to be a role in a unit"""
CONVERTERS = 255.0, 1023.0, 4095.0, 16383.0, 65535.0
"""counts of usual converters at their supply"""
KPA_PER_N_MM2 = 1e3
ALIGNED = 3
"""times that a shift of the clocks is looked for"""


@dataclass(frozen=True)
class Layout:
    """What a user says about files."""

    columns: Mapping[Role, str] = field(default_factory=dict)
    """name, or number from 1 on, of the column of a role; a unit may follow after a colon"""
    area_mm2: float | None = None
    """area that a force presses on"""
    divider_ohm: float | None = None
    """resistor from the output to ground, below the cell"""
    supply_v: float | None = None
    counts: float | None = None
    """counts at the supply"""
    only: str | None = None
    """value of the column of cells; rows of other cells are left out"""
    align: bool = False
    """whether clocks that are apart are shifted"""
    as_guessed: bool = False
    """whether guesses are taken"""


@dataclass(frozen=True)
class _Column:
    """A column of a role, of one table."""

    role: Role
    table: Table
    place: int
    unit: Unit
    guessed: bool

    def __str__(self) -> str:
        return f"{self.role} is '{self.table.header[self.place]}' in {self.unit.name}"


def read_files(
    paths: Sequence[str | Path],
    layout: Layout,
    *,
    roles: tuple[Role, ...] = ("time", "load", "reading"),
    note: Callable[[str], None] = lambda said: None,
) -> dict[str, FloatArray]:
    """Columns ``time_s``, ``pressure_kpa`` and ``resistance_ohm`` of equal length (n,), those of ``roles``.

    A file that has these names is taken as it is. Otherwise the units in the headers say what a column is, the caller's
    ``layout`` comes first, and what is left is guessed. Of two files the one with the load is resampled at the times
    of the other.

    Raises:
        InputError: a file cannot be read; a column is missing or may be one of several; a guess is not confirmed; or a
            force comes without an area, or volts without a divider.
    """
    names = [name for name, role in zip(COLUMNS, ("time", "load", "reading"), strict=True) if role in roles]
    tables = [Table(path, note=note) for path in paths]
    if len(tables) == 1 and layout == Layout() and set(names) <= set(tables[0].header):
        found_columns = tables[0].columns(names)
        return unrepeated(str(paths[0]), found_columns, found_columns.pop(LINE), note)
    found = _found(tables, layout, roles)
    _confirm(found, layout, note)
    time = {column.table.path: _numbers(column) for column in found if column.role == "time"}
    columns, line = {}, None
    for column in found:
        if column.role == "reading":
            values = _ohms(column, layout)
            columns["time_s"], columns["resistance_ohm"] = time[column.table.path], values
            line = np.array(column.table.lines, dtype=np.float64)
            kept = _rows_of(column.table, layout)
            columns, line = {name: of[kept] for name, of in columns.items()}, line[kept]
    load = next((column for column in found if column.role == "load"), None)
    if load is not None:
        kept = _rows_of(load.table, layout)
        columns = _together(time[load.table.path][kept], _pressures(load, layout)[kept], columns, layout, note)
        if len(columns["time_s"]) != len(line):  # type: ignore[arg-type]  # there is a reading
            line = None
    return unrepeated(str(paths[-1]), {name: columns[name] for name in names}, line, note)


def load_recording(
    paths: Sequence[str | Path],
    layout: Layout = Layout(),
    *,
    trust_units: bool = False,
    note: Callable[[str], None] = lambda said: None,
) -> Recording:
    """A recording to calibrate a cell by: :func:`read_files`, then :func:`._recording.checked_recording`."""
    columns = read_files(paths, layout, note=note)
    name = " and ".join(map(str, paths))
    return checked_recording(*(columns[name_] for name_ in COLUMNS), name=name, trust_units=trust_units)


def _found(tables: Sequence[Table], layout: Layout, roles: tuple[Role, ...]) -> list[_Column]:
    """The column of each role; with two tables, a time in each."""
    if len(tables) == 1:
        return [_column(tables[0], role, layout, roles) for role in roles]
    if len(tables) != 2 or "load" not in roles:
        raise InputError(f"{len(tables)} files; expected one, or one with the load and one with the readings")
    first, second = tables
    if not _candidates(first, "load") and _candidates(second, "load"):
        first, second = second, first
    pairs = ((first, ("time", "load")), (second, ("time", "reading")))
    return [_column(table, role, layout, of) for table, of in pairs for role in of]  # type: ignore[arg-type]


def _candidates(table: Table, role: Role) -> list[int]:
    """Columns whose header has a unit of a role, or else whose name is one."""
    parsed = [header_unit(name) for name in table.header]
    by_unit = [
        place for place, (_, unit) in enumerate(parsed) if unit is not None and unit.quantity in QUANTITIES[role]
    ]
    return by_unit or [
        place for place, (name, unit) in enumerate(parsed) if unit is None and name.lower() in WORDS[role]
    ]


def _column(table: Table, role: Role, layout: Layout, roles: tuple[Role, ...]) -> _Column:
    said = layout.columns.get(role)
    if said is not None:
        return _said(table, role, said)
    places = _candidates(table, role)
    if len(places) > 1:
        names = ", ".join(f"'{table.header[place]}'" for place in places)
        raise InputError(f"{table.path}: the {role} may be {names}; --column {role}=NAME says which")
    if places:
        name, unit = header_unit(table.header[places[0]])
        word = unit_named(WORDS[role].get(name.lower(), ""))
        return _Column(role, table, places[0], unit or word or _usual(role), guessed=unit is None)
    if not table.named and len(table.header) == len(roles):
        return _Column(role, table, roles.index(role), _usual(role), guessed=True)
    raise InputError(
        f"{table.path}: no column is the {role} by its unit or name; the columns are "
        f"{', '.join(table.header)}; --column {role}=NAME:UNIT says which"
    )


def _usual(role: Role) -> Unit:
    unit = unit_named({"time": "s", "load": "kPa", "reading": "ohm"}[role])
    assert unit is not None
    return unit


def _said(table: Table, role: Role, said: str) -> _Column:
    """The column that the user has named, by its header, by its header without the unit, or by its number."""
    name, _, after = said.rpartition(":")
    unit = unit_named(after) if name and said not in table.header else None
    name = name if unit is not None else said
    plain = [header_unit(header)[0].lower() for header in table.header]
    if name in table.header:
        place = table.header.index(name)
    elif plain.count(name.lower()) == 1:
        place = plain.index(name.lower())
    elif name.isdigit() and 1 <= int(name) <= len(table.header):
        place = int(name) - 1
    else:
        raise InputError(f"{table.path}: no column '{name}'; expected one of {', '.join(table.header)}")
    stated, in_header = header_unit(table.header[place])
    word = unit_named(WORDS[role].get(stated.lower(), ""))
    unit = unit or in_header
    found = unit or word or _usual(role)
    if found.quantity not in QUANTITIES[role]:
        raise InputError(
            f"{table.path}: column '{table.header[place]}' is in {found.name}, which is no unit of a {role}"
        )
    return _Column(role, table, place, found, guessed=unit is None)


def _confirm(found: Sequence[_Column], layout: Layout, note: Callable[[str], None]) -> None:
    """Say what was guessed; InputError unless the user takes it."""
    guesses = [str(column) for column in found if column.guessed]
    if not guesses:
        return
    path = found[-1].table.path
    if not layout.as_guessed:
        raise InputError(
            f"{path}: guessed: {'; '.join(guesses)}: --as-guessed takes this, --column ROLE=NAME:UNIT says otherwise"
        )
    note(f"{path}: guessed: {'; '.join(guesses)}")


def _numbers(column: _Column) -> FloatArray:
    values = column.table.numbers(column.place, dates=column.role == "time")
    return np.asarray(values * column.unit.factor)


def _pressures(column: _Column, layout: Layout) -> FloatArray:
    values = _numbers(column)
    if column.unit.quantity == "pressure":
        return values
    if layout.area_mm2 is None:
        raise InputError(f"{column.table.path}: {column}, a force; --area MM2 makes it a pressure")
    return np.asarray(values / layout.area_mm2 * KPA_PER_N_MM2)


def _ohms(column: _Column, layout: Layout) -> FloatArray:
    """Readings in ohm; a divider's output at ground, or no conductance, is an open cell."""
    values = _numbers(column)
    with np.errstate(divide="ignore"):
        match column.unit.quantity:
            case "resistance":
                return values
            case "conductance":
                return np.where(values > 0, 1 / values, np.inf)
        if layout.divider_ohm is None or layout.supply_v is None:
            raise InputError(f"{column.table.path}: {column}; --divider OHM --supply V make it a resistance")
        share = values / (_full_counts(column, values, layout) if column.unit.quantity == "counts" else layout.supply_v)
        ohm = np.where(share > 0, layout.divider_ohm * (1 / share - 1), np.inf)
        return np.where(share < 1, ohm, np.nan)  # at the supply the converter tells nothing


def _full_counts(column: _Column, values: FloatArray, layout: Layout) -> float:
    if layout.counts is not None:
        return layout.counts
    largest = float(np.nanmax(values))
    guess = next((full for full in CONVERTERS if largest <= full), None)
    if guess is None or not layout.as_guessed:
        told = "" if guess is None else f"; {guess:g} is guessed, which --as-guessed takes"
        raise InputError(
            f"{column.table.path}: {column}, of which the largest is {largest:g}: how many are the supply? --counts N "
            f"says it{told}"
        )
    return guess


def _rows_of(table: Table, layout: Layout) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Rows of the cell that was asked for (n,), of a file in long format."""
    named = layout.columns.get("cell")
    if named is None or named not in table.header:
        return np.ones(len(table.lines), dtype=np.bool_)
    texts = np.array(table.texts(table.header.index(named)))
    cells = np.unique(texts).tolist()
    if layout.only not in cells:
        raise InputError(
            f"{table.path}: column '{named}' has {', '.join(cells[:8])}; --only VALUE says which cell to read"
        )
    return np.asarray(texts == layout.only)


def _together(
    load_time_s: FloatArray,
    pressure_kpa: FloatArray,
    readings: dict[str, FloatArray],
    layout: Layout,
    note: Callable[[str], None],
) -> dict[str, FloatArray]:
    """Loads at the times of the readings, after a shift of the clocks if the user allows it."""
    time_s = readings["time_s"]
    same = load_time_s.shape == time_s.shape and bool(np.array_equal(load_time_s, time_s))
    if same and not layout.align:
        return readings | {"pressure_kpa": pressure_kpa}
    known = np.isfinite(load_time_s) & np.isfinite(pressure_kpa)
    load_time_s, pressure_kpa = load_time_s[known], pressure_kpa[known]
    order = np.argsort(load_time_s, kind="stable")
    load_time_s, pressure_kpa = load_time_s[order], pressure_kpa[order]
    shorter = min(float(np.ptp(load_time_s)), float(np.ptp(time_s)))
    overlap = min(load_time_s[-1], time_s[-1]) - max(load_time_s[0], time_s[0])
    if overlap < shorter / 2:
        if not layout.align:
            raise InputError(
                f"the clocks of load and readings hardly overlap: {load_time_s[0]:.6g} to {load_time_s[-1]:.6g} s, and "
                f"{time_s[0]:.6g} to {time_s[-1]:.6g} s; --align starts both at once"
            )
        shift = float(time_s[0] - load_time_s[0])
        note(f"the clock of the load is shifted by {shift:.6g} s, so that both begin at once")
        load_time_s = load_time_s + shift
    for _ in range(ALIGNED if layout.align else 0):
        inside = (time_s >= load_time_s[0]) & (time_s <= load_time_s[-1]) & (readings["resistance_ohm"] > 0)
        inside &= np.isfinite(readings["resistance_ohm"])
        pressure = np.interp(time_s[inside], load_time_s, pressure_kpa)
        lead_s = clock_shift_s(Recording(time_s[inside], pressure, readings["resistance_ohm"][inside]))
        if not lead_s:
            break
        note(f"the resistance changes {lead_s:.3g} s before the load does: the clock of the load is shifted by that")
        load_time_s = load_time_s - lead_s
    inside = (time_s >= load_time_s[0]) & (time_s <= load_time_s[-1])
    kept = {name: of[inside] for name, of in readings.items()}
    return kept | {"pressure_kpa": np.interp(kept["time_s"], load_time_s, pressure_kpa)}
