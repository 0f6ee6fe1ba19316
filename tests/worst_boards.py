"""Random boards, and an attack on their stated worst cases by chance.

The attack has its own tolerances, converter, host and errors, and knows of the package only how to read many boards at
once. What it says of a stated corner comes from the exact nodal analysis of ``bench/_reference.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import Boards, Design, Requirement, Settling, operating_point, scan_population, stability
from ohmskin.errors import SolverError
from ohmskin.verification import Report, verify

Array = NDArray[np.float64]
Pressed = NDArray[np.bool_]
CIRCUITS = ("inverting-amplifier", "row-amplifier", "voltage-divider", "voltage-feedback")
QUANTITIES = ("crosstalk", "reading_error", "gain_error", "output_headroom", "adc_headroom")
LINES = {"row_lead": "rows", "row_segment": "rows", "column_lead": "columns", "column_segment": "columns"}
PER_SENSED = ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")
EITHER_SIGN = (
    "readout.offset_voltage",
    "readout.bias_current",
    "adc.offset_voltage",
    "adc.gain_error",
    "adc.inl_steps",
)
SLACK = 1.01
"""by which chance may beat a stated worst case"""


def random_board(seed: int, *, largest: int = 8) -> Design:
    """A board of any circuit, 2 x 2 to 8 x 8, tolerances from 0.1 to 20 %, offsets near and far of the signal."""
    random = np.random.default_rng(seed)
    circuit = str(random.choice(CIRCUITS))
    rows, columns = (int(n) for n in random.integers(2, largest + 1, 2))

    def part(value: float) -> Any:
        kind = random.integers(3)
        if kind == 0:
            return value
        return {"nominal": value, "tolerance": float(10 ** random.uniform(-3, np.log10(0.2)))}

    rest = 10 ** random.uniform(3.5, 4.8)
    change = float(random.choice([10 ** random.uniform(-1.1, -0.2), 10 ** random.uniform(0.05, 0.5)]))
    drive = float(random.choice([-1.0, -0.5, 0.5, 2.5]))
    least = rest * min(change, 1.0)
    amplified = circuit.endswith("amplifier")
    signal = abs(drive) if not amplified else float(random.uniform(0.5, 2.0))
    reference = signal / abs(drive) * least if amplified else float(10 ** random.uniform(-1, 0.5) * least)
    smallest = signal * min(1.0, 1.0 / change) / max(1.0, change) if amplified else 0.1 * signal
    level = float(random.choice([0.0, 1.65]))
    reach = 1.3 * signal if random.random() < 0.7 else 1.02 * signal
    idle = "float" if random.random() < 0.2 and circuit != "voltage-feedback" else "ground"
    tables: dict[str, Any] = {
        "array": {"rows": rows, "columns": columns}
        | {name: part(float(10 ** random.uniform(-1, 2.3))) for name in ("row_lead", "column_lead")}
        | {name: part(float(10 ** random.uniform(-2, 0.7))) for name in ("row_segment", "column_segment")},
        "drive": {"voltage": part(drive), "idle_rows": idle},
        "readout": {
            "circuit": circuit,
            "reference_resistance": part(reference),
            "reference_voltage": part(level) if level else 0.0,
            "open_loop_gain": float(10 ** random.uniform(3.5, 6)),
            "offset_voltage": float(smallest * 10 ** random.uniform(-3, -0.6)) if random.random() < 0.5 else 1e-3,
            "bias_current": float(10 ** random.uniform(-9, -7)),
            "supply": (level - reach, level + reach),
        },
        "cells": {
            "rest_resistance": part(float(rest)),
            "full_scale_resistance": float(rest * change),
            "full_scale_kpa": 20.0,
        },
    }
    if circuit == "voltage-divider":
        tables["readout"]["idle_columns"] = str(random.choice(["float", "load"]))
    if random.random() < 0.7:
        tables["adc"] = {
            "bits": int(random.integers(10, 17)),
            "range": (level - reach, level + reach),
            "offset_voltage": float(random.choice([0.0, 1e-3])),
            "gain_error": float(random.choice([0.0, 2e-3])),
            "inl_steps": float(random.choice([0.0, 1.0])),
        }
    return Design.model_validate(tables)


def host_signal(design: Design, ohms: float) -> float:
    """V, magnitude of the ideal circuit's signal."""
    reference = float(np.mean(design.readout.reference_resistance))
    amplified = design.readout.circuit.endswith("amplifier")
    return abs(design.drive.voltage) * reference / (ohms if amplified else ohms + reference)


def random_board_in_time(seed: int, *, largest: int = 3) -> Design:
    """A board as above that takes time, and whose bandwidth, capacitances and temperature vary."""
    random = np.random.default_rng([seed, 1])
    circuit = str(random.choice(("inverting-amplifier", "row-amplifier", "voltage-divider")))
    rows, columns = (int(n) for n in random.integers(1, largest + 1, 2))
    rest = float(10 ** random.uniform(3.7, 5.0))
    full = rest * float(10 ** random.uniform(-0.9, 0.4))

    def part(low: float, high: float, widest: float = 0.4) -> dict[str, float]:
        tolerance, drift = float(10 ** random.uniform(-2, np.log10(widest))), float(random.uniform(-1e-3, 1e-3))
        return {"nominal": float(10 ** random.uniform(low, high)), "tolerance": tolerance} | (
            {"temperature_coefficient": drift} if random.random() < 0.5 else {}
        )

    amplified = circuit.endswith("amplifier")
    readout: dict[str, Any] = {"circuit": circuit, "column_capacitance": part(-10.5, -8.5)}
    readout["reference_resistance"] = {"nominal": min(rest, full) if amplified else rest, "tolerance": 0.05}
    if amplified:
        readout |= {"open_loop_gain": 1e5, "gain_bandwidth": part(5.0, 6.7), "feedback_capacitance": part(-12, -10)}
        if random.random() < 0.3:
            readout |= {"columns": "multiplexed", "idle_columns": str(random.choice(["float", "ground"]))}
    else:
        readout["idle_columns"] = str(random.choice(["float", "load"]))
    adc = {"bits": 12, "range": (-9.0, 9.0), "sampling_capacitance": 1e-11, "switch_resistance": 1e3}
    if random.random() < 0.4:
        adc["acquisition_time"] = 2e-6
    return Design.model_validate(
        {
            "array": {
                "rows": rows,
                "columns": columns,
                "row_lead": part(0.0, 2.3),
                "column_lead": part(0.0, 3.0),
            },
            "drive": {
                "voltage": 1.0,
                "idle_rows": "float" if random.random() < 0.2 else "ground",
                "idle_leakage": LEAKAGE_A,
            },
            "readout": readout,
            "adc": adc,
            "cells": {"rest_resistance": rest, "full_scale_resistance": full, "full_scale_kpa": 20.0},
            "operation": {
                "frame_rate": float(10 ** random.uniform(2.5, 3.7)),
                "temperature_range": (273.15, 333.15),
            },
        }
    )


IN_TIME = ("settling_error", "fastest_scan", "phase_margin")
BORNE = ("cell_voltage", "cell_power", "switch_current", "switch_power", "output_current")
BORNE += ("reference_voltage", "reference_power", "leakage_error")
LEAKAGE_A = 1e-8


def drawn_design(design: Design, random: np.random.Generator, *, corner: bool) -> tuple[Design, Array]:
    """One board of a design with cells anywhere in their range, or everything at an end."""

    def share(size: int = 1) -> Array:
        return random.choice([-1.0, 1.0], size) if corner else random.uniform(-1.0, 1.0, size)

    low, high = design.operation.temperature_range or (298.15, 298.15)
    kelvin = float((low + high) / 2 + share()[0] * (high - low) / 2) - 298.15
    changes: dict[str, dict[str, Any]] = {}
    for key, spread in design.spreads.items():
        section, name = key.split(".")
        value = np.asarray(getattr(getattr(design, section), name), dtype=float)
        lines = design.array.rows if name.startswith("row_") else design.array.columns
        if name in ("gain_bandwidth", "column_capacitance", "feedback_capacitance"):
            lines = 1
        elif section == "readout":
            lines = 1 if design.board.multiplexed else design.board.shape[1]
        found = value * (1.0 + spread.tolerance * share(lines) + spread.temperature_coefficient * kelvin)
        changes.setdefault(section, {})[name] = float(found[0]) if lines == 1 else tuple(found.tolist())
    cells = design.cells
    assert cells is not None
    press = (1.0 + share(design.array.rows * design.array.columns)) / 2.0
    ohms = cells.rest_resistance + press * (cells.full_scale_resistance - cells.rest_resistance)
    return design.replace(**changes), ohms.reshape(design.array.shape)


def borne_and_in_time(design: Design, nominal: Design, cells: Array) -> dict[str, float]:
    """What one board says of each quantity in time and of each stress, in the unit of the catalogue."""
    assert nominal.cells is not None
    assert nominal.adc is not None
    point = operating_point(design, cells)
    found = {
        "cell_voltage": float(point.cell_voltage.max()),
        "cell_power": float(point.cell_power.max()),
        "switch_current": float(point.driver_current.max()),
        "switch_power": float(point.driver_power.max()),
        "output_current": float(point.output_current.max()),
        "reference_voltage": float(point.reference_voltage.max()),
        "reference_power": float(point.reference_power.max()),
        "leakage_error": 100.0 * LEAKAGE_A * float((point.leakage / np.abs(point.signal)).max()),
    }
    settling = Settling(design, cells)
    largest = max(host_signal(nominal, o) for o in (nominal.cells.rest_resistance, nominal.cells.full_scale_resistance))
    period = 1.0 / (nominal.operation.frame_rate or 1.0) / nominal.board.shape[0]
    found["settling_error"] = 100.0 * settling.error(period) * settling.signal / largest
    with suppress(SolverError):
        shortest = settling.shortest_period(min(nominal.adc.step / 4.0 / settling.signal, 0.5))
        found["fastest_scan"] = 1.0 / shortest / nominal.board.shape[0]
    if design.board.virtual_grounds:
        found["phase_margin"] = float(np.nanmin(stability(design, cells).phase_margin))
    return found


def beaten_in_time(design: Design, seed: int, report: Report, count: int = 60) -> dict[str, tuple[float, float]]:
    """Stated limits of stresses and of quantities in time that chance beats by more than :data:`SLACK`."""
    random = np.random.default_rng([seed, 2])
    found = beaten_by_its_own_boards(report)
    says = {r.requirement.quantity: r.measurement.value for r in report.results if r.measurement is not None}
    for number in range(count):
        board, cells = drawn_design(design, random, corner=number % 2 == 0)
        for quantity, value in borne_and_in_time(board, design, cells).items():
            if quantity not in says:
                continue
            stated_value, least = says[quantity], quantity in ("fastest_scan", "phase_margin")
            worse = value < stated_value / SLACK if least else value > SLACK * stated_value + 1e-9
            if worse:
                found[quantity] = stated_value, value
    return found


def beaten_by_its_own_boards(report: Report) -> dict[str, tuple[float, float]]:
    """Stated worst cases that one of the random boards beside them beats by more than :data:`SLACK`."""
    found = {}
    for result in report.results:
        measurement, quantity = result.measurement, result.requirement.quantity
        if measurement is None or measurement.bounds is None:
            continue
        side = -1.0 if quantity.endswith("headroom") or quantity in ("fastest_scan", "phase_margin") else 1.0
        drawn, limit = side * measurement.bounds.sampled, side * measurement.value
        if drawn > limit + (SLACK - 1.0) * abs(limit) + 1e-9:
            found[f"{quantity}, own boards"] = measurement.value, measurement.bounds.sampled
    return found


@dataclass(frozen=True)
class Drawn:
    """Boards at random places of their tolerances: values (S, lines) by key, cells (S, rows, columns) relative."""

    parts: dict[str, Array]
    cells: Array


def draw(design: Design, random: np.random.Generator, count: int, *, corners: bool) -> Drawn:
    """Boards whose parts are at the ends of their tolerances, or anywhere within."""

    def deviations(lines: int) -> Array:
        shape = (count, lines)
        return random.choice([-1.0, 1.0], shape) if corners else random.uniform(-1.0, 1.0, shape)

    return drawn_by(design, count, deviations)


def drawn_by(design: Design, count: int, deviations: Callable[[int], Array]) -> Drawn:
    """Boards whose parts deviate by (S, lines) shares of their tolerances, as ``deviations(lines)`` says in turn."""
    spreads = design.spreads
    rows, columns = design.array.shape
    sensed = rows if design.readout.circuit == "row-amplifier" else columns
    keys = {f"array.{name}": getattr(design.array, kind) for name, kind in LINES.items()}
    keys |= {f"readout.{name}": sensed for name in PER_SENSED}
    keys |= dict.fromkeys(("drive.voltage", "readout.reference_voltage"), 1)
    if design.adc is not None:
        keys |= dict.fromkeys(("adc.offset_voltage", "adc.gain_error", "adc.inl_steps"), 1)
    parts = {}
    for key, lines in keys.items():
        section, name = key.split(".")
        nominal = np.broadcast_to(np.asarray(getattr(getattr(design, section), name), dtype=float), lines)
        spread = spreads.get(key)
        if spread is not None:
            parts[key] = nominal + (spread.tolerance * np.abs(nominal) + spread.deviation) * deviations(lines)
        elif key in EITHER_SIGN and nominal.any():
            parts[key] = np.abs(nominal) * deviations(lines)
        else:
            parts[key] = np.broadcast_to(nominal, (count, lines))
    spread = spreads.get("cells.rest_resistance")
    if spread is None:
        return Drawn(parts, np.ones((count, rows, columns)))
    return Drawn(parts, 1.0 + spread.tolerance * deviations(rows * columns).reshape(count, rows, columns))


def host_ohms(design: Design, volts: Array) -> Array:
    """What the law of the ideal circuit makes of volts."""
    signal = volts - design.readout.reference_voltage
    with np.errstate(divide="ignore"):
        ratio = design.drive.voltage / signal
    ohms: Array = design.readout.reference_resistance * (
        -ratio if design.readout.circuit.endswith("amplifier") else ratio - 1.0
    )
    return ohms


def by_share(design: Design) -> bool:
    """Whether errors are shares of full scale: of cells that span more than a decade, here all of falling ones."""
    assert design.cells is not None
    return design.cells.rest_resistance > 10.0 * design.cells.full_scale_resistance


def displayed(design: Design, ohms: Array) -> Array:
    """What errors are judged of: ohm, or the share of full scale of a contact that loads join to the cell."""
    if not by_share(design):
        return ohms
    assert design.cells is not None
    rest, full = 1.0 / design.cells.rest_resistance, 1.0 / design.cells.full_scale_resistance
    with np.errstate(divide="ignore"):
        return np.asarray((np.maximum(1.0 / ohms, 0.0) - rest) / (full - rest))


@dataclass(frozen=True)
class Read:
    """Outputs in V, the lowest and highest value that the host may display, the true one, and what says nothing."""

    output: Array
    converted: Array
    low: Array
    high: Array
    true: Array
    lost: Array
    known: Array | bool = True


def as_read(design: Design, output: Array, true: Array, errors: Array) -> Read:
    """The chain behind the outputs (S, rows, columns) with the converter's errors (S, 3)."""
    low, high = design.readout.supply
    lost = (output <= low) | (output >= high) if design.readout.circuit != "voltage-divider" else np.zeros(output.shape)
    volts, half = output, 0.0
    if design.adc is not None:
        offset, slope, bow = (errors[:, k, None, None] for k in range(3))
        first, last = design.adc.range
        step = (last - first) / 2**design.adc.bits
        above = (output - first) * (1.0 + slope) + offset
        share = np.clip(above / (last - first), 0.0, 1.0)
        volts, half = first + above + 4.0 * bow * step * share * (1.0 - share), step / 2.0
        lost = lost.astype(bool) | (volts < first + step) | (volts >= last - step)
    positive = design.drive.voltage > 0
    up = positive != design.readout.circuit.endswith("amplifier")
    level, side = design.readout.reference_voltage, 1.0 if up else -1.0
    signal = (volts - level) * side
    full = np.inf if design.readout.circuit.endswith("amplifier") else abs(design.drive.voltage)
    lost = lost.astype(bool) | ~(full - signal > half)
    seen = volts
    if by_share(design):  # the open end is the cell at rest
        assert design.cells is not None
        both = design.cells.rest_resistance, design.cells.full_scale_resistance
        middle = np.mean([host_signal(design, ohms) for ohms in both])
        lost &= signal > middle
        seen = volts if design.adc is None else np.clip(volts, *design.adc.range)
        seen_ends = [level + side * np.maximum(side * (seen + end - level), 0.0) for end in (-half, half)]
    else:
        lost |= ~(signal > half)
        seen_ends = [volts - half, volts + half]
    ends = np.stack([displayed(design, host_ohms(design, end)) for end in seen_ends])
    return Read(output, volts, ends.min(axis=0), ends.max(axis=0), displayed(design, true), lost)


def errors_of(design: Design, quantity: str, frames: list[Read]) -> Array:
    """The quantity of every reading of the last frame: relative, or V beyond the nearer limit."""
    first, last = frames[0], frames[-1]
    lost = np.asarray(first.lost | last.lost)
    if quantity == "output_headroom":
        return np.maximum(design.readout.supply[0] - last.output, last.output - design.readout.supply[1])
    if quantity == "adc_headroom":
        assert design.adc is not None
        (low, high), step = design.adc.range, design.adc.step
        below, above = low + step - last.converted, last.converted - high + step
        if by_share(design):
            rises = (design.drive.voltage > 0) != design.readout.circuit.endswith("amplifier")
            return above if rises else below
        return np.maximum(below, above)
    if by_share(design):
        change = last.true - first.true
        found = {
            "reading_error": np.maximum(last.high - last.true, last.true - last.low),
            "crosstalk": np.maximum(last.high - first.low, first.high - last.low),
            "gain_error": np.maximum(last.high - first.low - change, change - last.low + first.high),
        }[quantity]
    elif quantity == "reading_error":
        found = np.maximum(last.high / last.true - 1.0, 1.0 - last.low / last.true)
    elif quantity == "crosstalk":
        found = np.maximum(last.high / first.low - 1.0, 1.0 - last.low / first.high)
    else:
        with np.errstate(divide="ignore", invalid="ignore"):  # of cells that do not change
            change = last.true - first.true
            ends = [(last.high - first.low) / change - 1.0, (last.low - first.high) / change - 1.0]
        found = np.maximum(np.abs(ends[0]), np.abs(ends[1]))
    return np.where(lost, np.inf, found)


def values(design: Design, drawn: Drawn, pattern: Pressed, own: Pressed, *, resolved: bool = True) -> dict[str, Array]:
    """Each quantity of each board (S, rows, columns); -inf where it is not judged.

    Args:
        design: of the boards.
        drawn: the boards.
        pattern: (S, rows, columns) which cells are pressed.
        own: the cells whose gain is judged.
        resolved: whether frames with a saturated output are solved, one scan each; else that output alone is judged.
    """
    parts = {key.split(".")[1]: value for key, value in drawn.parts.items() if not key.startswith("adc.")}
    boards, cells = replace(Boards.of(design), **parts), design.cells
    assert cells is not None
    converter = np.zeros((len(pattern), 3))
    if design.adc is not None:
        converter = np.concatenate([drawn.parts[key] for key in EITHER_SIGN[2:]], axis=1)

    def frame(pressed: Pressed, supply: tuple[float, float] = design.readout.supply) -> Read:
        true = np.where(pressed, cells.full_scale_resistance, cells.rest_resistance) * drawn.cells
        limited = design.replace(readout={"supply": supply})
        found = scan_population(limited, boards, true, resolve_saturation=resolved)
        unknown = found.saturated.any(axis=(1, 2)) & (not resolved)
        return replace(as_read(limited, found.volts, true, converter), known=~unknown[:, None, None])

    rest, mixed, free = frame(np.zeros_like(pattern)), frame(pattern), frame(pattern, (-np.inf, np.inf))
    before, after = frame(pattern & ~own), frame(pattern | own)
    untouched = ~pattern & rest.known & mixed.known
    found = {
        "crosstalk": np.where(untouched, errors_of(design, "crosstalk", [rest, mixed]), -np.inf),
        "reading_error": errors_of(design, "reading_error", [mixed]),
        "gain_error": np.where(
            own & before.known & after.known, errors_of(design, "gain_error", [before, after]), -np.inf
        ),
    }
    if design.readout.circuit != "voltage-divider":
        found["output_headroom"] = errors_of(design, "output_headroom", [free])
    if design.adc is not None:
        found["adc_headroom"] = errors_of(design, "adc_headroom", [free])
    return found


def attack(design: Design, seed: int, count: int, *, corners: bool, resolved: bool = False) -> dict[str, float]:
    """The largest value of each quantity that chance finds."""
    random = np.random.default_rng(seed)
    drawn = draw(design, random, count, corners=corners)
    shape = design.array.shape
    pattern = random.uniform(size=(count, *shape)) < random.uniform(0.0, 1.0, (count, 1, 1))
    own = np.zeros((count, *shape), dtype=np.bool_)
    own[np.arange(count), random.integers(shape[0], size=count), random.integers(shape[1], size=count)] = True
    return {name: float(v.max()) for name, v in values(design, drawn, pattern, own, resolved=resolved).items()}


def stated(report: Report) -> dict[str, float]:
    """What a report states of each quantity, as :func:`errors_of` counts it."""
    found = {}
    for result in report.results:
        if result.measurement is not None and result.method == "worst-case":
            value = result.measurement.value
            headroom = result.requirement.quantity.endswith("headroom")
            found[result.requirement.quantity] = -value if headroom else value / 100
    return found


def by_hand(design: Design, quantity: str, report: Report) -> float:
    """The quantity at the corner that the report names, by exact nodal analysis."""
    measurement = next(r.measurement for r in report.results if r.requirement.quantity == quantity)
    assert measurement is not None
    assert measurement.corner is not None
    corner = measurement.corner
    changes: dict[str, dict[str, Any]] = {}
    for key, values in corner.parts.items():
        section, name = key.split(".")
        changes.setdefault(section, {})[name] = values[0] if len(values) == 1 else tuple(values)
    board = design.replace(**changes)
    if quantity.endswith("headroom"):
        board = board.replace(readout={"supply": (-np.inf, np.inf)})
    errors = np.zeros((1, 3)) if board.adc is None else np.array([[getattr(board.adc, k[4:]) for k in EITHER_SIGN[2:]]])
    frames = []
    for ohms in corner.cells_ohm:
        cells = np.array(ohms)
        volts = reference_volts(board, cells)
        frames.append(as_read(design, volts[None], cells[None], errors))
    return float(errors_of(design, quantity, frames)[0][corner.cell])


def asked(design: Design) -> list[Requirement]:
    """The worst cases of a board, and the yield of its reading error."""
    quantities = [q for q in QUANTITIES if q != "adc_headroom" or design.adc is not None]
    quantities = [q for q in quantities if q != "output_headroom" or design.readout.circuit != "voltage-divider"]
    wanted = [Requirement(id=q, quantity=q, max=1e9) for q in quantities]
    return [*wanted, Requirement(id="Y", quantity="reading_error", max=1.0, method="monte-carlo")]


def beaten(design: Design, seed: int, report: Report, count: int = 2000) -> dict[str, tuple[float, float]]:
    """Stated worst cases that chance beats by more than :data:`SLACK`, with what chance found."""
    says = stated(report)
    found = beaten_by_its_own_boards(report)
    tries = ((count, True, False), (count, False, False), (count // 20, True, True))
    for boards, corners, resolved in tries:
        for quantity, value in attack(design, seed, boards, corners=corners, resolved=resolved).items():
            limit = says[quantity]
            if value > limit + (SLACK - 1.0) * abs(limit):
                found[quantity] = limit, max(value, found.get(quantity, (0.0, -np.inf))[1])
    return found


def asked_in_time(design: Design) -> list[Requirement]:
    """The worst cases of a board in time, and what its parts bear."""
    return [Requirement(id=name, quantity=name, max=1e9) for name in (*IN_TIME, *BORNE)]


def main(first: int, last: int) -> None:
    """Attack the verdicts of so many random boards, and print which were beaten."""
    for seed in range(first, last):
        design, in_time = random_board(seed), random_board_in_time(seed)
        report = verify(design, requirements=asked(design), samples=200)
        again = verify(in_time, requirements=asked_in_time(in_time))
        found = beaten(design, seed, report) | beaten_in_time(in_time, seed, again, count=1000)
        print(seed, design.readout.circuit, in_time.readout.circuit, found or "not beaten", flush=True)


if __name__ == "__main__":  # python tests/worst_boards.py FIRST LAST
    main(*map(int, sys.argv[1:3]))
