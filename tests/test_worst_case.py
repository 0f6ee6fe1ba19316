"""Worst cases against chance, against every corner of small boxes, and against the report that states them."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from worst_boards import (
    CIRCUITS,
    QUANTITIES,
    Array,
    asked,
    asked_in_time,
    beaten,
    beaten_by_its_own_boards,
    beaten_in_time,
    by_hand,
    drawn_by,
    random_board,
    random_board_in_time,
    stated,
    values,
)

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import Design, Requirement, scan
from ohmskin.verification import Report, verify
from ohmskin.verification._box import Corners
from ohmskin.verification._dut import DesignUnderTest
from ohmskin.verification._judging import worst_of
from ohmskin.verification._montecarlo import Sampler
from ohmskin.verification._outcome import Measurement
from ohmskin.verification._readings import ReadingErrorTarget
from ohmskin.verification._search import _Search
from ohmskin.verification.quantities.reading_errors import Crosstalk, GainError, ReadingError

QUICK = (3, 5, 6, 11, 12, 22, 156, 285, 291)
"""seeds of small boards of all circuits, some of whose readings come near the reference or leave a range; of the last
three errors are shares of full scale"""


def _verified(design: Design) -> Report:
    return verify(design, requirements=asked(design), samples=200)


def _agree(value: float, again: float) -> bool:
    return value == again or abs(value - again) <= 1e-6 * max(abs(value), 1e-3)


@pytest.mark.parametrize("seed", QUICK)
def test_chance_does_not_beat_a_stated_worst_case(seed: int) -> None:
    design = random_board(seed, largest=5)
    report = _verified(design)
    assert beaten(design, seed, report) == {}
    for quantity, value in stated(report).items():
        assert _agree(value, by_hand(design, quantity, report)), quantity


def test_chance_does_not_beat_outputs_that_stop_where_cells_are_open() -> None:
    """Cells open at rest read what outputs cannot go below: errors of one sign start from nothing, and grow larger."""
    design = Design.model_validate(
        {
            "array": {"rows": 6, "columns": 5, "row_lead": {"nominal": 12.0, "tolerance": 0.3}, "column_lead": 6.0},
            "drive": {"voltage": 3.3},
            "readout": {
                **{"circuit": "voltage-feedback", "reference_resistance": 2200.0, "open_loop_gain": 1e5},
                **{"offset_voltage": {"nominal": 0.0, "deviation": 3e-3}, "supply": [0.0, 3.3]},
            },
            "adc": {"bits": 12, "range": [0.0, 3.3]},
            "cells": {"rest_resistance": 1e7, "full_scale_resistance": 1500.0, "full_scale_kpa": 200.0},
        }
    )
    report = verify(design, requirements=[Requirement(id="D", quantity="crosstalk", max=1e9)], samples=100)
    assert beaten_by_its_own_boards(report) == {}


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 300, 10))
def test_chance_does_not_beat_any_of_300_boards(first: int) -> None:
    for seed in range(first, first + 10):
        design = random_board(seed)
        report = _verified(design)
        assert beaten(design, seed, report) == {}, seed
        for quantity, value in stated(report).items():
            assert _agree(value, by_hand(design, quantity, report)), (seed, quantity)


@pytest.mark.parametrize("seed", [0, 3, 5, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 4))])
def test_chance_beats_no_verdict_in_time_and_no_stress(seed: int) -> None:
    design = random_board_in_time(seed)
    report = verify(design, requirements=asked_in_time(design))
    assert beaten_in_time(design, seed, report) == {}
    for result in report.results:
        if result.measurement is not None and result.measurement.corner is not None:
            assert _says_what_is_pressed(design, result.measurement), result.requirement.quantity


def _says_what_is_pressed(design: Design, measurement: Measurement) -> bool:
    """Whether the words name the cells of the last frame that are nearer to full scale."""
    assert design.cells is not None
    assert measurement.corner is not None
    cells = np.array(measurement.corner.cells_ohm[-1])
    middle = (design.cells.rest_resistance + design.cells.full_scale_resistance) / 2.0
    pressed = (cells < middle) == (design.cells.full_scale_resistance < middle)
    said = re.search(r"all cells (pressed|at rest)|cells (not )?pressed: ([^;a-z.]*)", measurement.where)
    if said is None:
        return False
    if said[1] is not None:
        return bool(pressed.all() if said[1] == "pressed" else not pressed.any())
    named = np.zeros(pressed.shape, dtype=np.bool_)
    for row, column in re.findall(r"\((\d+), (\d+)\)", said[3]):
        named[int(row), int(column)] = True
    return bool((named == pressed).all() if said[2] is None else (named == ~pressed).all())


SMALL = Design.model_validate(
    {
        "array": {"rows": 2, "columns": 2, "row_lead": {"nominal": 50.0, "tolerance": 0.2}, "column_lead": 20.0},
        "drive": {"voltage": -1.0},
        "readout": {
            "circuit": "inverting-amplifier",
            "reference_resistance": 10e3,
            "offset_voltage": 3e-3,
            "open_loop_gain": 1e4,
            "supply": (-3.0, 3.0),
        },
        "adc": {"bits": 12, "range": (-3.0, 3.0)},
        "cells": {
            "rest_resistance": {"nominal": 10e3, "tolerance": 0.05},
            "full_scale_resistance": 17e3,
            "full_scale_kpa": 20.0,
        },
    }
)


@pytest.mark.parametrize(
    ("circuit", "idle_rows"),
    [*((name, "ground") for name in CIRCUITS), ("inverting-amplifier", "float"), ("voltage-divider", "float")],
)
def test_no_corner_of_a_small_box_is_worse(circuit: str, idle_rows: str) -> None:
    """Every corner of parts and cells, with every press, of a 2 x 2 array."""
    design = SMALL.with_circuit(circuit).replace(drive={"idle_rows": idle_rows})
    signs = np.array(list(product((-1.0, 1.0), repeat=8)))  # 2 leads, 2 offsets, 4 cells
    presses = np.array(list(product((False, True), repeat=4))).reshape(-1, 2, 2)
    columns = iter(signs.T)
    drawn = drawn_by(design, len(signs), lambda lines: np.stack([next(columns) for _ in range(lines)], axis=1))
    says = stated(_verified(design))
    worst = dict.fromkeys(says, -np.inf)
    for pattern in presses:
        for cell in range(4):
            own = np.zeros((len(signs), 2, 2), dtype=np.bool_)
            own.reshape(-1, 4)[:, cell] = True
            found = values(design, drawn, np.broadcast_to(pattern, own.shape), own)
            worst = {name: max(worst[name], float(found[name].max())) for name in worst}
    assert says == pytest.approx(worst, rel=1e-8)


@pytest.mark.parametrize("target", [Crosstalk(), ReadingError(), GainError()], ids=lambda target: target.name)
def test_the_derivatives_of_an_error_are_the_differences_of_its_values(target: ReadingErrorTarget) -> None:
    """By parts, presses and deviations of cells, at a point within the box; of both signs."""
    box, random = worst_of(DesignUnderTest(SMALL.replace(adc=None)), target).box, np.random.default_rng(2)
    moves = 1e-3 * np.concatenate([np.eye(box.size), -np.eye(box.size)])
    for sign in (1.0, -1.0):
        point = Corners(np.array([0]), np.array([1]), np.array([sign]), random.uniform(-0.8, 0.8, (1, box.size)))
        ends = target.evaluate(box, point.at((point.x + moves)[None])).reshape(2, -1)
        found, expected = target.gradient(box, point), (ends[0] - ends[1]) / 2e-3
        assert found is not None
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("seed", [1, 3, 4])
def test_a_random_board_is_judged_by_presses_that_are_bad_for_it(seed: int) -> None:
    """Beside the worst of all cells, signs and presses; those that hurt a board with nominal parts need not hurt it."""
    target, random = ReadingError(), np.random.default_rng(seed)
    worst = worst_of(DesignUnderTest(random_board(seed, largest=3)), target)
    box, parts = worst.box, len(worst.box.factors)
    boards = random.uniform(-1.0, 1.0, (3, parts + box.cells))
    presses = np.array(list(product((-1.0, 1.0), repeat=box.cells)))
    row, column, sign = (index.ravel() for index in np.meshgrid(*(range(n) for n in box.shape), (-1.0, 1.0)))
    judged = Sampler.of(worst).judged(boards)
    for board, value in zip(boards, judged.tolist(), strict=True):
        own = (np.broadcast_to(part, (len(presses), part.size)) for part in (board[:parts], board[parts:]))
        x = np.repeat(np.insert(np.concatenate(list(own), axis=1), [parts], presses, axis=1), len(row), axis=0)
        every = Corners(*(np.tile(index, len(presses)) for index in (row, column)), np.tile(sign, len(presses)), x)
        most = float(target.evaluate(box, every).max())
        assert 0.8 * most <= value <= most * (1.0 + 1e-9)


def test_a_move_of_a_line_takes_its_presses_to_one_end() -> None:
    box, random = worst_of(DesignUnderTest(SMALL), ReadingError()).box, np.random.default_rng(1)
    search, start = _Search(ReadingError(), box), random.choice([-1.0, 1.0], (1, box.size))
    for number, line in enumerate(box.lines()):
        for end, move in ((1.0, box.size + 2 * number), (-1.0, box.size + 2 * number + 1)):
            moved = search._after(start, np.array([move]), start)[0]
            np.testing.assert_array_equal(moved, np.where(line, end, start[0]))
    for move in range(box.size):
        moved = search._after(start, np.array([move]), start)[0]
        np.testing.assert_array_equal(moved, np.where(np.arange(box.size) == move, -start[0], start[0]))


CASES = {
    "one offset takes untouched cells beyond the reference": (
        {"offset_voltage": 5.6e-3, "reference_resistance": 26.8e3, "reference_voltage": 0.5, "supply": (0.025, 3.275)},
        {"rest_resistance": {"nominal": 60e3, "tolerance": 0.1}, "full_scale_resistance": 6.1e3},
        -0.5,
        {"crosstalk": np.inf, "reading_error": np.inf, "gain_error": np.inf},
    ),
    "cells of their own spread saturate an output": (
        {"offset_voltage": 5.5e-3, "reference_resistance": 30.4e3, "reference_voltage": 0.5, "supply": (0.025, 3.275)},
        {"rest_resistance": {"nominal": 60e3, "tolerance": 0.1}, "full_scale_resistance": 6.1e3},
        -0.52,
        {"reading_error": np.inf},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_reading_beyond_the_reference_is_an_infinite_error(name: str) -> None:
    readout, cells, drive, expected = CASES[name]
    design = Design.model_validate(
        {
            "array": {"rows": 10, "columns": 5, "row_lead": 2.0},
            "drive": {"voltage": {"nominal": drive, "tolerance": 0.01}},
            "readout": {"circuit": "inverting-amplifier", "open_loop_gain": 25e3, **readout},
            "adc": {"bits": 12, "range": (0.0, 3.3)},
            "cells": {"full_scale_kpa": 100.0, **cells},
        }
    )
    report = _verified(design)
    says = stated(report)
    for quantity, value in expected.items():
        assert says[quantity] == value
        assert by_hand(design, quantity, report) == value


@pytest.mark.parametrize("seed", [3, 8])
def test_no_line_of_the_budget_and_no_board_exceeds_the_verdict(seed: int) -> None:
    report = _verified(random_board(seed, largest=4))
    verdict = {r.requirement.quantity: r.measurement for r in report.results if r.method == "worst-case"}
    for quantity in QUANTITIES[:3]:
        found = verdict[quantity]
        assert found is not None
        assert max(found.contributions.values(), default=0.0) <= found.value
    sampled = report.results[-1].measurement
    assert sampled is not None
    assert verdict["reading_error"] is not None
    assert max(sampled.samples) <= verdict["reading_error"].value


def test_page_one_says_that_a_search_is_not_complete(tmp_path: Path) -> None:
    report = verify(SMALL, only=["D1", "D4", "D18"], samples=400)
    crosstalk, headroom, sampled = (result.measurement for result in report.results)
    assert crosstalk is not None
    assert headroom is not None
    assert sampled is not None
    assert crosstalk.incomplete == headroom.incomplete == "by search, all of 4 cells"
    report.write(tmp_path)
    assert (tmp_path / "report.html").read_text().count("by search, all of 4 cells") == 2
    assert "its worst cell, with the presses" in sampled.text[1]


@pytest.mark.parametrize("nominal", [0.0, 1e-3])
def test_a_drift_has_its_own_unit_whatever_the_nominal_value(nominal: float) -> None:
    """10 uV/K over 40 K is an offset of 0.4 mV, of either sign on each line."""
    base = SMALL.replace(operation={"temperature_range": (268.15, 338.15)})
    drifting = base.replace(readout={"offset_voltage": {"nominal": nominal, "temperature_coefficient": 10e-6}})
    alike = base.replace(readout={"offset_voltage": {"nominal": nominal, "deviation": 0.4e-3}})
    steady = base.replace(readout={"offset_voltage": {"nominal": nominal, "deviation": 0.0}})
    one, other, none = (stated(_verified(design)) for design in (drifting, alike, steady))
    assert one == pytest.approx(other, rel=1e-9)
    assert one["reading_error"] > 1.01 * none["reading_error"]


def test_parts_of_one_supply_move_together() -> None:
    """A supply of 5 % that drive, reference and converter follow shifts no reading of a ratiometric board."""
    ideal = {"offset_voltage": 0.0, "open_loop_gain": np.inf, "supply": (-np.inf, np.inf)}
    fixed = SMALL.replace(
        readout={**ideal, "reference_voltage": {"nominal": 1.2, "tolerance": 0.05}},
        adc={"gain_error": {"nominal": 0.0, "tied_to": "readout.reference_voltage"}, "range": (0.0, 5.0)},
        drive={"voltage": {"nominal": -1.0, "tied_to": "readout.reference_voltage"}},
        array={"row_lead": 0.0, "column_lead": 0.0},
    )
    tied = stated(_verified(fixed))["reading_error"]
    still = stated(
        _verified(
            fixed.replace(readout={"reference_voltage": 1.2, "spread": {}}, adc={"spread": {}}, drive={"spread": {}})
        )
    )
    loose = stated(_verified(fixed.replace(drive={"voltage": -1.0, "spread": {}})))
    assert tied == pytest.approx(still["reading_error"], rel=1e-9)
    assert loose["reading_error"] > 0.04


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drive": {"voltage": {"nominal": -1.0, "tied_to": "readout.reference_voltage"}}}, "which is 0 V"),
        ({"drive": {"voltage": {"nominal": -1.0, "tied_to": "drive.voltage"}}}, "which follows another part"),
    ],
)
def test_a_tie_to_nothing_is_bad_input(changes: dict[str, object], message: str) -> None:
    with pytest.raises(Exception, match=message):
        SMALL.replace(**changes)


def test_currents_and_leakage_are_judged_and_bounded_by_a_solution() -> None:
    design = SMALL.replace(drive={"idle_leakage": 1e-6, "idle_rows": "float"})
    asked_for = [
        Requirement(id=name, quantity=name, max=1e9) for name in ("output_current", "switch_current", "leakage_error")
    ]
    output, switch, leakage = (result.measurement for result in verify(design, requirements=asked_for).results)
    assert output is not None
    assert switch is not None
    assert leakage is not None
    signal = np.abs(reference_volts(design, np.full((2, 2), 9.5e3))).max() / 10e3
    assert signal < output.value < 1.1 * signal
    assert 1.8 * signal < switch.value < 2.2 * signal
    everything_into_one_column = 100 * 1e-6 / (1.0 / (17e3 * 1.05))
    assert 0.5 * everything_into_one_column < leakage.value < everything_into_one_column
    named = {
        requirement.id
        for requirement in verify(design, only=["D25"]).results[0:1]
        for requirement in [requirement.requirement]
    }
    assert named == {"D25"}


def test_a_worst_case_never_falls_when_tolerances_grow() -> None:
    design = random_board(8, largest=3)
    found = []
    for factor in (1.0, 2.0):
        changes: dict[str, dict[str, object]] = {"readout": {"offset_voltage": factor * design.readout.offset_voltage}}
        for key, spread in design.spreads.items():
            section, name = key.split(".")
            part = {
                "nominal": getattr(getattr(design, section), name),
                "tolerance": min(factor * spread.tolerance, 0.5),
            }
            changes.setdefault(section, {})[name] = part
        found.append(stated(_verified(design.replace(**changes))))
    for quantity, smaller in found[0].items():
        assert found[1][quantity] == smaller or found[1][quantity] >= smaller - 1e-6 * abs(smaller), quantity


@pytest.mark.parametrize("seed", [1, 2])
def test_offsets_that_drive_currents_through_floating_rows_are_found(seed: int) -> None:
    """A product of presses and offsets, of which derivatives about nominal parts know nothing; at any cell."""
    random = np.random.default_rng(seed)
    rows, columns = (int(count) for count in random.integers(4, 7, 2))
    rest, drive = 10 ** random.uniform(4.3, 4.8), float(random.choice([-1.0, 2.5]))
    pressed = rest / random.uniform(5.0, 9.5)
    offset, leads = 1e-3 * random.uniform(0.5, 2.0), {"row_segment": 3.0, "column_segment": 2.0, "row_lead": 11.0}
    design = Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns, **leads},
            "drive": {"voltage": drive, "idle_rows": "float"},
            "readout": {
                **{"circuit": "inverting-amplifier", "reference_resistance": 0.3 * pressed, "supply": (-3.0, 3.0)},
                **{"open_loop_gain": 1e6, "offset_voltage": offset},
            },
            "cells": {"rest_resistance": rest, "full_scale_resistance": pressed, "full_scale_kpa": 20.0},
        }
    )
    only = [Requirement(id="crosstalk", quantity="crosstalk", max=1e9)]
    found = verify(design, requirements=only).results[0].measurement
    assert found is not None

    def change(row: int, column: int, sign: float, volts: Callable[[Design, Array], Array]) -> float:
        own = sign * np.where(np.arange(columns) == column, -offset, offset)
        board = design.replace(readout={"offset_voltage": tuple(own.tolist())})
        before = np.full((rows, columns), rest)
        after = np.full((rows, columns), pressed)
        after[row, column] = rest
        return 100 * abs(float(volts(board, before)[row, column] / volts(board, after)[row, column]) - 1.0)

    ends = product(range(rows), range(columns), (-1.0, 1.0))
    worst = max(ends, key=lambda end: change(*end, volts=lambda board, cells: scan(board, cells).volts))
    assert change(*worst, volts=reference_volts) <= found.value * (1 + 1e-9)
