"""Search for wrong readings: random designs, rich in rare parts, against exact rational arithmetic.

    python -m ohmskin.bench.search --seconds 600 --seed 1

Each design is made from a family's name and a number, so that a finding can be made again from these two. The search
prints how many designs of each family were read, how many were refused, and the worst figures. It exits with 1 if any
finding is an error:

* a *broken bound*: an output is farther from the exact one than ``error_bound`` says;
* an *invented answer*: the circuit has no unique solution, and the reading is neither refused nor infinite nor without
  any bound;
* a *needless refusal*: the circuit has a unique solution, and the reading is refused;
* a *crash*: any other exception.

An *empty bound* (above 1e-6 of the largest output) is counted and no error.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from math import inf
from typing import Any

import click
import numpy as np

from ..circuits import CIRCUITS, METHODS, Design, scan
from ..common.arrays import FloatArray
from ..errors import SolverError
from . import _live_search, _live_streams, harness
from ._reference import Indeterminate, reference_volts
from .harness import column

_ULP = float(np.finfo(np.float64).eps)
_NOTHING = 1e-30  # V; ideal parts are stood for by conductances 1e40 times the largest one
_EMPTY = 1e-6  # bounds above say nothing worth knowing

Draw = np.random.Generator
Tables = dict[str, Any]


def sample(family: str, number: int) -> tuple[Design, FloatArray]:
    """The design and the cells (rows, columns) in ohm of one number of a family."""
    draw = np.random.default_rng([number, *family.encode()])
    shape = _shape(draw, family)
    tables = _readout(draw, shape)
    cells = FAMILIES[family](draw, tables, shape)
    return Design.model_validate(tables), cells


def _shape(draw: Draw, family: str) -> tuple[int, int]:
    if family == "one line":
        long = int(draw.integers(1, 7))
        return (1, long) if draw.random() < 0.5 else (long, 1)
    rows, columns = draw.integers(2, 5, 2).tolist()
    return (rows, columns) if rows * columns <= 12 else (rows, 3)


def _readout(draw: Draw, shape: tuple[int, int]) -> Tables:
    """A design with a readout of any kind and lines without resistance."""
    circuit = str(draw.choice(CIRCUITS))
    sensed = shape[0] if circuit == "row-amplifier" else shape[1]
    readout: Tables = {
        "circuit": circuit,
        "reference_resistance": _alike(draw, [1e3, 1e4, 1.0], sensed),
        "open_loop_gain": _alike(draw, [inf, 1e5, 1e5, 10.0, 1.0], sensed),
        "reference_voltage": float(draw.choice([0.0, 0.0, 1.65])),
    }
    if draw.random() < 0.3:
        readout["offset_voltage"] = _alike(draw, [1e-3, -1e-3, 0.0], sensed)
    if draw.random() < 0.2:
        readout["bias_current"] = _alike(draw, [1e-7, 0.0], sensed)
    if draw.random() < 0.2:
        readout["supply"] = [-0.5, 3.3]
    drive: Tables = {"voltage": float(draw.choice([-1.0, 1.0, 3.3]))}
    if circuit != "voltage-feedback":
        _idle_lines(draw, drive, readout)
    return {"array": {"rows": shape[0], "columns": shape[1]}, "drive": drive, "readout": readout}


def _idle_lines(draw: Draw, drive: Tables, readout: Tables) -> None:
    """What lines do that are not selected, or not read."""
    drive["idle_rows"] = str(draw.choice(["ground", "float", "pull"]))
    if drive["idle_rows"] == "pull":
        drive["idle_row_resistance"] = float(draw.choice([1e2, 1e4, 1e6]))
    if draw.random() < 0.3:
        readout |= {"columns": "multiplexed", "idle_columns": str(draw.choice(["float", "ground", "load"]))}
        shared = {key: value[0] for key, value in readout.items() if key != "supply" and isinstance(value, list)}
        readout |= shared
    elif readout["circuit"] == "voltage-divider":
        readout["idle_columns"] = str(draw.choice(["float", "load"]))


def _alike(draw: Draw, values: list[float], count: int) -> float | list[float]:
    """One value for all lines, or one of the values for each."""
    return float(draw.choice(values)) if draw.random() < 0.6 else draw.choice(values, count).tolist()


def _lines(draw: Draw, tables: Tables, leads: list[float], segments: list[float]) -> None:
    array = tables["array"]
    for key, values in (("lead", leads), ("segment", segments)):
        array[f"row_{key}"] = _alike(draw, values, array["rows"])
        array[f"column_{key}"] = _alike(draw, values, array["columns"])


def _real(draw: Draw, decades: tuple[float, float], count: int) -> list[float]:
    return [float(f"{value:.3g}") for value in 10 ** draw.uniform(*decades, count)]


def _shorts(draw: Draw, tables: Tables, shape: tuple[int, int]) -> FloatArray:
    """Shorted cells, some lines ideal and others not."""
    leads = [0.0, *_real(draw, (0.0, 2.0), 3)]
    _lines(draw, tables, leads, [0.0] if draw.random() < 0.6 else [0.0, *_real(draw, (-2.0, 2.0), 2)])
    return draw.choice([0.0, 1e4, 1e4, np.inf], shape, p=[0.45, 0.25, 0.2, 0.1])


def _ties(draw: Draw, tables: Tables, shape: tuple[int, int]) -> FloatArray:
    """All parts of one or two equal values."""
    value = float(draw.choice([1.0, 3.0, 10.0, 1e3]))
    _lines(draw, tables, [0.0, value, value], [0.0, value, value])
    tables["readout"]["reference_resistance"] = value
    return draw.choice([value, 2.0 * value, np.inf, 0.0], shape, p=[0.6, 0.2, 0.1, 0.1])


def _mixed_lines(draw: Draw, tables: Tables, shape: tuple[int, int]) -> FloatArray:
    """Ideal and real lines side by side, ordinary cells."""
    _lines(draw, tables, [0.0, 0.0, *_real(draw, (-1.0, 2.0), 2)], [0.0, 0.0, *_real(draw, (-2.0, 2.0), 2)])
    return 10 ** draw.uniform(2.0, 6.0, shape)


def _faults(draw: Draw, tables: Tables, shape: tuple[int, int]) -> FloatArray:
    """Bridges, breaks, open and shorted cells, complete or partial."""
    _lines(draw, tables, [0.0, 10.0, *_real(draw, (-1.0, 2.0), 1)], [0.0, 1.0, *_real(draw, (-2.0, 2.0), 1)])
    tables["fault"] = [_fault(draw, shape) for _ in range(draw.integers(1, 4))]
    return draw.choice([1e4, 1e4, 2e4, 5e3, 0.0, np.inf], shape, p=[0.4, 0.2, 0.15, 0.15, 0.05, 0.05])


def _fault(draw: Draw, shape: tuple[int, int]) -> Tables:
    kinds = ["open-cell", "shorted-cell", "broken-row", "broken-column"]
    kinds += ["bridged-rows"] * (shape[0] > 1) + ["bridged-columns"] * (shape[1] > 1)
    kind, place = str(draw.choice(kinds)), [int(draw.integers(length)) for length in shape]
    fault: Tables = {"kind": kind, "place": place}
    if draw.random() < 0.5:
        fault["resistance"] = float(draw.choice([0.0, 1e-3, 10.0, 1e4, 1e9, np.inf]))
    if kind.startswith("bridged"):
        axis = 0 if kind == "bridged-rows" else 1
        fault["to"] = (place[axis] + int(draw.integers(1, shape[axis]))) % shape[axis]
    return fault


def _one_line(draw: Draw, tables: Tables, shape: tuple[int, int]) -> FloatArray:
    """1 x N and N x 1."""
    _lines(draw, tables, [0.0, *_real(draw, (-1.0, 3.0), 2)], [0.0, *_real(draw, (-1.0, 3.0), 2)])
    if draw.random() < 0.3:
        tables["fault"] = [_fault(draw, shape)]
    return draw.choice([0.0, np.inf, 1e4, *_real(draw, (2.0, 6.0), 3)], shape)


def _extremes(draw: Draw, tables: Tables, shape: tuple[int, int]) -> FloatArray:
    """Equal extreme values: wires of 1e-9 to 1e9 ohm, cells of 1e-9 to 1e15 ohm."""
    wires = draw.choice([0.0, 1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9], 2).tolist()
    _lines(draw, tables, wires, wires)
    tables["readout"]["open_loop_gain"] = float(draw.choice([1.0, 1e12, inf]))
    return draw.choice([0.0, 1e-9, 1e-3, 1.0, 1e4, 1e9, 1e15, np.inf], 3)[draw.integers(0, 3, shape)]


def _ordinary(draw: Draw, tables: Tables, shape: tuple[int, int]) -> FloatArray:
    """Cells of 100 ohm to 1 Mohm, lines of 10 mohm to 100 ohm, all different."""
    array = tables["array"]
    for line in ("row", "column"):
        for part in ("lead", "segment"):
            array[f"{line}_{part}"] = _real(draw, (-2.0, 2.0), array[f"{line}s"])
    return 10 ** draw.uniform(2.0, 6.0, shape)


FAMILIES: dict[str, Callable[[Draw, Tables, tuple[int, int]], FloatArray]] = {
    "shorts": _shorts,
    "ties": _ties,
    "mixed lines": _mixed_lines,
    "faults": _faults,
    "one line": _one_line,
    "extremes": _extremes,
    "ordinary": _ordinary,
}


@dataclass
class Tally:
    """What was found in one family."""

    family: str = field(default="", metadata=column("family", "{}", width=12))
    designs: int = field(default=0, metadata=column("designs", "{}", width=8))
    refused: int = field(default=0, metadata=column("refused", "{}"))
    """by the reading, rightly"""
    infinite: int = field(default=0, metadata=column("infinite", "{}"))
    """readings with an infinite output"""
    empty: int = field(default=0, metadata=column("empty", "{}"))
    """bounds above 1e-6"""
    error: float = field(default=0.0, metadata=column("error", "{:.1e}"))
    """largest error of an output, relative to the largest output of its frame"""
    used: float = field(default=0.0, metadata=column("/ bound", "{:.1e}"))
    """largest error over its bound"""
    bound: float = field(default=0.0, metadata=column("bound", "{:.1e}"))
    """largest bound that is not empty"""
    findings: list[str] = field(default_factory=list, metadata=column("findings", "{}"))


def check(family: str, number: int, tally: Tally) -> None:
    """Read one design by one of the methods and compare."""
    design, cells = sample(family, number)
    method = [None, *METHODS][number % (1 + len(METHODS))]
    tally.designs += 1

    def found(what: str) -> None:
        tally.findings.append(f"{what}: {family}:{number}, {design.readout.circuit}, method {method}")

    exact = _answer(design, cells)
    try:
        result = scan(design, cells, method=method)
    except SolverError as error:
        tally.refused += 1
        unlimited = design.replace(readout={"supply": (-inf, inf)})
        if exact is not None and _answer(unlimited, cells) is not None:
            found(f"needless refusal ({error})")
        return
    except Exception as error:  # whatever it is, it is a finding
        found(f"crash ({type(error).__name__}: {error})")
        return
    infinite = np.isinf(result.volts)
    tally.infinite += bool(infinite.any())
    if exact is None:
        if not infinite.any() and result.error_bound < inf:
            found("invented answer")
        return
    if infinite.any():
        found("infinite, and has a value")
        return
    largest = float(np.abs(exact).max())
    off = float(np.abs(result.volts - exact).max())
    if not result.error_bound <= _EMPTY:
        tally.empty += 1
    else:
        tally.bound = max(tally.bound, result.error_bound)
    if largest == 0.0:
        if off > _NOTHING and result.error_bound < inf:
            found(f"{off} V, and is 0")
        return
    tally.error = max(tally.error, off / largest if method in (None, "exact") else 0.0)
    if not off / largest <= result.error_bound + _ULP:
        found(f"broken bound ({off / largest:.1e} of {result.error_bound:.1e})")
    if result.error_bound > 0:
        tally.used = max(tally.used, (off / largest - _ULP) / result.error_bound)


def _answer(design: Design, cells: FloatArray) -> FloatArray | None:
    try:
        return reference_volts(design, cells)
    except Indeterminate:
        return None


def _shown(finding: str, known: Collection[str], *, live: bool) -> str:
    """The design and the cells of FAMILY:NUMBER, with --live those of each frame, and what was read of them."""
    family, _, number = finding.rpartition(":")
    if family not in known or not number.isdecimal():
        families = ", ".join(known)
        raise click.BadParameter(f"'{finding}'; expected FAMILY:NUMBER with one of {families}", param_hint="--show")
    if not live:
        design, cells = sample(family, int(number))
        return f"{_as_json(design)}\ncells = {cells.tolist()}"
    made = _live_streams.stream(family, int(number))
    if made is None:
        return f"{finding}: a board that cannot be read"
    frames = zip(made.cells.tolist(), made.noise_steps.tolist(), made.counts, strict=True)
    return "\n".join(
        [
            _as_json(made.design),
            *(f"cells = {cells}, noise_steps = {noise}, counts = {read.tolist()}" for cells, noise, read in frames),
        ]
    )


def _as_json(design: Design) -> str:
    return json.dumps(design.model_dump(exclude_defaults=True, warnings=False))


@click.command()
@click.option("--seconds", default=60.0, show_default=True, help="How long to search.")
@click.option("--seed", default=0, show_default=True, help="Where to start; another one gives other designs.")
@click.option("--family", multiple=True, help="Only these; default: all. Those of --live have other names.")
@click.option("--live", is_flag=True, help="Search for wrong live readings of quantised streams instead.")
@click.option("--show", help="Print the design of a finding, with --live its stream: FAMILY:NUMBER.")
def main(seconds: float, seed: int, family: tuple[str, ...], live: bool, show: str | None) -> None:
    """Search for readings that differ from exact arithmetic by more than they say."""
    known = _live_streams.FAMILIES if live else FAMILIES
    if unknown := set(family) - set(known):
        raise click.BadParameter(
            f"{', '.join(sorted(unknown))}; expected some of {', '.join(known)}", param_hint="--family"
        )
    if show is not None:
        click.echo(_shown(show, known, live=live))
        return
    if live:
        _search({name: _live_search.LiveTally(name) for name in family or known}, _live_search.check, seed, seconds)
    else:
        _search({name: Tally(name) for name in family or known}, check, seed, seconds)


def _search(
    tallies: dict[str, harness.Found], check: Callable[[str, int, harness.Found], None], seed: int, seconds: float
) -> None:
    """Print findings as they come, then the tallies; exits with 1 if there are any findings."""
    with contextlib.suppress(KeyboardInterrupt):  # the search may be ended at any time
        for finding in harness.search(tallies, check, seed, seconds):
            click.echo(finding)
    for line in harness.table(tallies.values()):
        click.echo(line)
    raise SystemExit(1 if any(tally.findings for tally in tallies.values()) else 0)


if __name__ == "__main__":
    main()
