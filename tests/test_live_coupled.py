"""The live recovery of coupled boards: its derivatives against the certified ones, and what a frame may cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import inf
from typing import Any

import numpy as np
import pytest

from ohmskin.bench import _live_hunt, _live_streams
from ohmskin.circuits import Design, Reason, adc_codes, scan, sensitivity
from ohmskin.circuits._sensitivity import basis_drops
from ohmskin.circuits.recovery import (
    _derivatives,
    _linearised,
    _lines,
    _normal_matrix,
    _quick_model,
    _sheet_model,
)
from ohmskin.circuits.recovery._below_range import BelowRange
from ohmskin.circuits.recovery._broken_lines import BrokenLines
from ohmskin.circuits.recovery._column_blocks import ColumnBlocks, beyond_linear
from ohmskin.circuits.recovery._column_scales import ColumnScales, _Scales
from ohmskin.circuits.recovery._coupled import CoupledLive
from ohmskin.circuits.recovery._coupled_board import CoupledBoard
from ohmskin.circuits.recovery._frame_account import Account
from ohmskin.circuits.recovery._frame_budget import ANEW_EFFORT, FIRST_EFFORT, NODE_EFFORT, Budget
from ohmskin.circuits.recovery._linearised import Base, Linearised
from ohmskin.circuits.recovery._lines import LineResistance
from ohmskin.circuits.recovery._node_blocks import NodeBlocks
from ohmskin.circuits.recovery._quick_model import QuickModel
from ohmskin.circuits.solvers import port_conductances
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader
from ohmskin.errors import InputError

KINDS = {
    "divider": ("voltage-divider", "ground", "float"),
    "loaded": ("voltage-divider", "ground", "load"),
    "open divider": ("voltage-divider", "float", "float"),
    "floating loaded": ("voltage-divider", "float", "load"),
    "feedback": ("voltage-feedback", "ground", "float"),
    "floating": ("inverting-amplifier", "float", "float"),
    "floating rows": ("row-amplifier", "float", "float"),
    "grounded": ("inverting-amplifier", "ground", "float"),
}
FLOATING = ("open divider", "floating loaded", "floating", "floating rows")
BY_COLUMN = ("divider", "loaded", "feedback", "grounded")


def board(kind: str, rows: int, columns: int, bits: int = 12, *, fault: Any = (), **array: Any) -> Design:
    circuit, idle_rows, idle_columns = KINDS[kind]
    amplified = circuit.endswith("amplifier")
    readout = {"circuit": circuit, "reference_resistance": 2e3 if amplified else 5e3, "idle_columns": idle_columns}
    if circuit != "voltage-divider":
        readout |= {"open_loop_gain": 1e4, "offset_voltage": 1e-3}
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns, "row_lead": 5.0, "column_lead": 5.0} | array,
            "drive": {"voltage": -1.0 if amplified else 3.3, "idle_rows": idle_rows},
            "readout": readout,
            "adc": {"bits": bits, "range": [0.0, 3.3]},
            "fault": fault,
        }
    )


FAULTS = (
    {"kind": "shorted-cell", "place": [1, 1], "resistance": 2e3},
    {"kind": "open-cell", "place": [2, 1], "resistance": 2e4},
)


@pytest.mark.parametrize(("segment", "small"), [(0.0, 144), (0.5, 0), (8.0, 0), (8.0, 144)])
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_those_of_the_adjoint_method(
    kind: str, segment: float, small: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_lines, "_SMALL", small)
    design = board(kind, 5, 4, row_segment=segment, column_segment=segment, fault=FAULTS)
    cells = 10 ** np.random.default_rng(1).uniform(2.8, 4.3, (5, 4))
    there = design.board
    found = np.full((20, 20), np.nan)
    meter, model = _normal_matrix.Meter(20), QuickModel(there, LineResistance(there))
    for _ in _derivatives.derivatives(there, there.turn(cells), model, meter, out=found):
        pass
    exact = sensitivity(design, cells).cell_conductance
    if there.turned:
        exact = exact.swapaxes(0, 1)[::-1, ::-1].swapaxes(-1, -2)[..., ::-1, ::-1]
    # A crosspoint's branch holds the cell with what is in series; sensitivities are by the cell without a shunt.
    np.testing.assert_allclose(found, exact.reshape(20, 20), rtol=2e-3, atol=1e-4 * np.abs(exact).max())


UNEQUAL = {"row_lead": [0.0, 5.0, 80.0, 5.0, 1.0], "column_segment": 0.0}


@pytest.mark.parametrize("cells", [(0.0, 6.0), (-3.0, 2.0), (8.0, 14.0)])
@pytest.mark.parametrize("lines", [{}, {"row_lead": 0.0, "column_segment": 20.0}, UNEQUAL])
def test_small_grids_are_one_system_of_equations(lines: dict[str, Any], cells: tuple[float, float]) -> None:
    """Against nested dissection and a sparse factorisation; ideal wires and open cells included."""
    there = board("open divider", 5, 4, **({"row_segment": 0.5, "column_segment": 0.5} | lines), fault=FAULTS).board
    ohm = 10 ** np.random.default_rng(3).uniform(*cells, (5, 4))
    ohm[3], ohm[0, 2] = np.inf, np.inf
    conductance, system = there.cell_conductance(ohm), LineResistance(there)
    assert system.can_solve(conductance)
    exact = port_conductances(conductance, there.lines).value
    # A row of open cells is joined to nothing, not even by rounding.
    np.testing.assert_allclose(system.ports(conductance), exact, rtol=1e-11, atol=1e-13 * exact.max())
    assert not system.ports(conductance)[3].any()
    np.testing.assert_allclose(system.drops(conductance), basis_drops(there, ohm), rtol=1e-9, atol=1e-11)


def test_shorts_and_broken_lines_are_left_to_solvers_that_are_exact_for_them() -> None:
    there, cells = board("divider", 3, 3, row_segment=0.5).board, np.full((3, 3), 1e3)
    assert LineResistance(there).can_solve(1.0 / cells)
    cells[0, 1] = 1e-9
    assert not LineResistance(there).can_solve(1.0 / cells)
    broken = board("divider", 3, 3, row_segment=0.5, fault=({"kind": "broken-row", "place": [1, 1]},)).board
    assert not LineResistance(broken).can_solve(np.full((3, 3), 1e-3))


def test_segments_of_small_boards_need_no_sparse_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams whose slowest frames took 13 and 14 usual ones, half of them for such a matrix."""

    def refused(*_: object) -> None:
        raise AssertionError("one dense system gives ports and fields")

    monkeypatch.setattr(_quick_model, "basis_drops", refused)
    monkeypatch.setattr(_quick_model, "port_conductances", refused)
    for number in (170000699, 170000809):
        found = _live_streams.stream("divider twofold", number)
        assert found is not None
        assert found.design.array.row_segment
        read = CountReader(found.design)
        for counts in found.counts:
            read(counts)


def test_what_a_frame_does_is_within_its_account(monkeypatch: pytest.MonkeyPatch) -> None:
    """Presses that looked like broken rows, and cells that run away beside segments: up to 19 usual frames."""
    done: list[tuple[str, float]] = []
    inside = 0

    def note(owner: type, name: str, price: Callable[..., float]) -> None:
        work = getattr(owner, name)

        def noted(*given: Any) -> Any:
            nonlocal inside
            if not inside:
                done.append((name, price(*given)))
            inside += 1
            try:
                return work(*given)
            finally:
                inside -= 1

        monkeypatch.setattr(owner, name, noted)

    note(CoupledBoard, "at", CoupledBoard.price)
    note(BrokenLines, "_breaks", lambda lines, *given: lines._price(given[-1]))
    note(BrokenLines, "_take_ratio", lambda lines, cells, *_: lines._price(cells))
    note(Base, "change", lambda base, *_: 45.0)  # each step
    note(Linearised, "renew", lambda _, renewal: renewal.price)
    note(Linearised, "_by_lines", lambda linearised, *_: linearised.prices.lines)
    note(ColumnScales, "_told", lambda scales, *_: scales._prices.told)
    note(_Scales, "changes", lambda scales: 0.0)
    note(_Scales, "_narrow", lambda scales, _: 180.0)
    did: set[str] = set()
    for number in (170000126, 170000135, 170000158, 170000408):
        found = _live_streams.stream("divider twofold", number)
        assert found is not None
        read = CountReader(found.design)
        for frame, counts in enumerate(found.counts):
            done.clear()
            read(counts)
            did |= {name for name, _ in done}
            assert isinstance(read._recover, CoupledLive)
            assert frame == 0 or sum(price for _, price in done) <= read._recover._prices.most(looks=False)
    assert {"_breaks", "renew", "at", "change", "_told", "changes"} <= did


@pytest.mark.parametrize("kind", ["feedback", "floating"])
def test_what_cells_below_the_range_change_is_worked_out_over_frames(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eleven of them: ten steps, which a frame cannot always pay for. The result is that of one frame that can."""
    design = board(kind, 5, 6).replace(readout={"offset_voltage": -3e-3})
    cells = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.2, 0.2, (5, 6))
    cells[1:3, :5] = cells[3, 0] = np.inf
    volts = scan(design, cells).volts
    parts = CoupledBoard(design.board)
    # What lies below the range reads as its lower end.
    read = np.maximum(volts, 0.5 * parts.half_step)
    frame = parts.frame(read, np.abs(read - parts.board.level), 0.0, None)
    log = -np.log(np.minimum(cells, 1e9)).ravel()
    known, linear, price = parts.at(log), Linearised(parts), parts.price(log)
    assert linear.begin(known, Budget(FIRST_EFFORT, Account(inf)))
    whole = BelowRange(parts)(frame, known, linear.base, Budget(FIRST_EFFORT, Account(inf)), price)
    step, steps = linear.base.step, 0

    def counted_step(apart: FloatArray) -> FloatArray:
        nonlocal steps
        steps += 1
        return step(apart)

    monkeypatch.setattr(linear.base, "step", counted_step)
    below, suffices, frames = BelowRange(parts), False, 0
    while not suffices:
        steps, frames = 0, frames + 1
        budget = Budget(FIRST_EFFORT, Account(3.5 * price))
        found = below(frame, known, linear.base, budget, price)
        suffices = budget.suffices
        assert steps <= 3
        assert frames < 20
    assert frames > 1
    np.testing.assert_allclose(found, whole, rtol=1e-12)


def test_a_search_that_is_not_paid_for_leaves_a_frame_unsettled() -> None:
    """Looking for rows of shorts that read like other cells behind followers takes up to eight rounds."""
    found = _live_streams.stream("feedback", 170000023)
    assert found is not None
    read = CountReader(found.design)
    recovery = read._recover
    assert isinstance(recovery, CoupledLive)
    for counts in found.counts:
        before = read(counts)
    assert before.valid.any()
    recovery._shorts._price = recovery._prices.lost_rows = inf
    after = read(found.counts[-1] + 1)
    assert not after.valid.any()
    assert (after.reason == Reason.UNSETTLED).any()


@pytest.mark.parametrize("shape", [(1, 6), (4, 1)])
def test_a_cell_without_a_contact_that_is_alone_on_its_line_does_not_end_the_reader(shape: tuple[int, int]) -> None:
    """Floating lines that nothing is connected to have no potential."""
    design = board("floating rows", *shape, fault=[{"kind": "open-cell", "place": [0, 0]}])
    reading = CountReader(design)(adc_codes(design, scan(design, np.full(shape, 1e4)).volts))
    assert reading.reason[0, 0] == Reason.HIDDEN


def test_no_step_waits_for_ever() -> None:
    """Strong presses on 16 x 12 cells with segments: potentials by sparse elimination are half of what a frame has."""
    found = _live_streams.stream("loaded events", 171000004)
    assert found is not None
    read = CountReader(found.design)
    for counts in found.counts:
        last = read(counts)
    assert last.valid.all()


@pytest.mark.parametrize("column_lead", [0.0, 50.0, 1e3])
@pytest.mark.parametrize("kind", BY_COLUMN)
def test_slopes_by_a_column_s_sum_are_exact_over_ideal_rows(kind: str, column_lead: float) -> None:
    """Against the adjoint method: what a column's other cells do to a reading, by way of the column's lead as well."""
    design = board(kind, 5, 2, row_lead=0.0, column_lead=column_lead)
    cells = 10 ** np.random.default_rng(1).uniform(2.5, 3.5, (5, 2))
    slopes = design.board.circuit.column_slopes(design.board, 1.0 / cells, (1.0 / cells).sum(axis=0))
    assert slopes is not None
    exact = sensitivity(design, cells).cell_conductance
    for j in range(2):
        found = np.diag(slopes[0][:, j]) + slopes[1][:, j, None]
        np.testing.assert_allclose(found, exact[:, j, :, j], rtol=1e-9)


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("kind", BY_COLUMN)
def test_steps_in_closed_form_are_those_of_the_whole_matrix(kind: str, bits: int) -> None:
    """To rounding on ideal lines, and to the share that the leads take on others."""
    for lead, agreement in ((0.0, 1e-9), (2.0, 0.05)):
        there = board(kind, 6, 5, bits, row_lead=lead, column_lead=lead, fault=FAULTS).board
        lines, cells = LineResistance(there), 10 ** np.random.default_rng(2).uniform(3.0, 4.3, (6, 5))
        jacobian = np.empty((30, 30))
        for _ in _derivatives.derivatives(
            there, cells, QuickModel(there, lines), _normal_matrix.Meter(30), out=jacobian
        ):
            pass
        noise = 3.3 / 2**bits / np.sqrt(12.0)
        jacobian *= ((cells + there.series_ohms) ** -2.0 * cells / noise).ravel()
        covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(30) / 9.0)
        blocks = ColumnBlocks(there, lines.to_driver, lines.to_end, noise)
        step = blocks.at(cells, np.full((6, 5), 3.0), np.zeros((6, 5), dtype=np.bool_))
        apart = np.random.default_rng(3).normal(scale=noise, size=30)
        expected = covariance @ (jacobian.T @ (apart / noise))
        assert np.abs(step.solve(apart) - expected).max() <= agreement * np.abs(expected).max()
        variance = np.diagonal(covariance)
        std = np.sqrt(variance + covariance**2 @ (beyond_linear(np.sqrt(variance)) / variance))
        assert (step.std.ravel() >= np.sqrt(variance) * (1.0 - 1e-9)).all()
        # A cell's own part of the correction is left out, which is small where it is known.
        known = std < 0.1
        assert known.sum() >= 25
        np.testing.assert_allclose(step.std.ravel()[known], std[known], rtol=max(agreement, 0.05))


def finger_on(shape: tuple[int, int], seed: int = 4) -> FloatArray:
    """Ohm of cells that differ, with a patch at a tenth of that."""
    cells = 1e4 * 10 ** np.random.default_rng(seed).uniform(-0.3, 0.3, shape)
    cells[2:5, 3:6] *= 0.1
    return cells


@pytest.mark.parametrize("segment", [0.0, 0.5])
@pytest.mark.parametrize("kind", FLOATING)
def test_products_with_the_derivatives_need_no_matrix(kind: str, segment: float) -> None:
    there = board(kind, 6, 5, row_segment=segment, column_segment=segment, fault=FAULTS).board
    cells = finger_on((there.shape[0], there.shape[1]))
    model = QuickModel(there, LineResistance(there))
    matrix = np.empty((30, 30))
    for _ in _derivatives.derivatives(there, cells, model, _normal_matrix.Meter(30), out=matrix):
        pass
    products = model.products(cells)
    assert products is not None
    draw = np.random.default_rng(5)
    change = draw.normal(size=there.shape)
    expected = (matrix @ change.ravel()).reshape(there.shape)
    np.testing.assert_allclose(products.times(change), expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
    expected = (change.ravel() @ matrix).reshape(there.shape)
    found = products.transposed_times(change)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
    whole = matrix.reshape(*there.shape, *there.shape)
    np.testing.assert_allclose(products.along_rows(), np.einsum("rcrj->rcj", whole), rtol=1e-9)
    np.testing.assert_allclose(products.down_columns(), np.einsum("rcic->cri", whole), rtol=1e-9)


TIES = {"none": (), "loop": ((2, 3), (5, 6)), "column": ((2, 3), (5, 3)), "row": ((2, 3), (2, 5), (2, 7))}
"""crosspoints of 30 ohm, which put others in parallel: a reading hardly tells (2, 6) from (5, 3) beside a loop"""


@pytest.mark.parametrize(("ties", "bits"), [("none", 8), ("none", 12), *((ties, 14) for ties in TIES)])
@pytest.mark.parametrize("kind", FLOATING)
def test_steps_by_conjugate_gradients_are_those_of_the_whole_matrix(kind: str, ties: str, bits: int) -> None:
    """Steps to a fraction of a standard deviation; deviations never less than the exact ones, nor much more."""
    there = board(kind, 11, 12, bits).board
    cells, model = there.turn(finger_on((11, 12))), QuickModel(there, LineResistance(there))
    for place in TIES[ties]:
        cells[place] = 30.0
    matrix = np.empty((132, 132))
    for _ in _derivatives.derivatives(there, cells, model, _normal_matrix.Meter(132), out=matrix):
        pass
    noise = 3.3 / 2**bits / np.sqrt(12.0)
    jacobian = matrix / (cells * noise).ravel()
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(132) / 9.0)
    step = NodeBlocks(there, model, noise).at(cells, np.full(there.shape, 3.0))
    apart = np.random.default_rng(6).normal(scale=noise, size=132)
    std = np.sqrt(np.diagonal(covariance))
    off = np.abs(step.solve(apart) - covariance @ (jacobian.T @ (apart / noise)))
    # Beside ties the slowest mode is left to further steps. It is one that is hardly known.
    assert (off <= (0.1 if ties == "none" else 1.2) * std).all()
    ratio = step.std.ravel() / std
    known = std < 0.1
    assert known.sum() >= 40
    assert ratio[known].min() >= (1.0 if ties == "none" else 0.98)
    if ties == "none":
        assert ratio[known].max() <= 1.6


@pytest.mark.parametrize("size", [5, 64, 200])
def test_the_normal_matrix_is_inverted_in_instalments_of_bounded_work(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_normal_matrix, "_LEAST", 2**14)
    monkeypatch.setattr(_normal_matrix, "_PER_ENTRY", 4)
    spent: list[int] = []
    counting = _normal_matrix.Meter.is_full

    def is_full(self: _normal_matrix.Meter, work: int) -> bool:
        full = counting(self, work)
        if full or not spent:
            spent.append(0)
        spent[-1] += work
        return full

    monkeypatch.setattr(_normal_matrix.Meter, "is_full", is_full)
    draw = np.random.default_rng(size)
    jacobian, prior = draw.normal(size=(size, size)), draw.uniform(0.5, 3.0, size)
    normal, meter = _normal_matrix.NormalMatrix(jacobian, prior), _normal_matrix.Meter(size)
    instalments = 1 + sum(1 for _ in normal.instalments(meter))
    expected = np.linalg.inv(jacobian.T @ jacobian + np.diag(prior**-2.0))
    np.testing.assert_allclose(normal.inverse, expected, rtol=1e-9, atol=1e-12)
    residual = draw.normal(size=size)
    np.testing.assert_allclose(normal.step(residual), expected @ jacobian.T @ residual, rtol=1e-8, atol=1e-12)
    assert instalments == len(spent)
    assert max(spent) <= meter.limit
    assert sum(spent) == 2 * size**3  # nothing is left out of the account
    if size == 200:
        assert instalments > 20


def test_a_normal_matrix_that_rounding_makes_singular_has_an_inverse() -> None:
    """Cells that readings cannot tell from each other, beside a prior far below the last digit."""
    normal = _normal_matrix.NormalMatrix(np.full((6, 6), 1e9), np.full(6, 3.0))
    for _ in normal.instalments(_normal_matrix.Meter(6)):
        pass
    assert np.isfinite(normal.inverse).all()
    assert (np.diagonal(normal.inverse) > 0.0).all()


def counted(monkeypatch: pytest.MonkeyPatch, *methods: tuple[type, str]) -> Counter[str]:
    """Counts calls of methods, by name, but for those that return False: instalments that could not be paid."""
    done: Counter[str] = Counter()

    def count(where: type, name: str) -> None:
        real = getattr(where, name)

        def counting(*given: Any) -> Any:
            result = real(*given)
            done[name] += result is not False
            return result

        monkeypatch.setattr(where, name, counting)

    for where, name in methods:
        count(where, name)
    return done


@pytest.mark.parametrize(("kind", "small"), [*((kind, 100) for kind in KINDS), *((kind, 20) for kind in FLOATING)])
def test_no_event_takes_more_than_a_frame_s_work(kind: str, small: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hard press of all cells at once, cells at a limit, a dead row, and back: counted per frame."""
    monkeypatch.setattr(_linearised, "_SMALL", small)
    effort = ANEW_EFFORT if small == 100 else NODE_EFFORT
    done = counted(monkeypatch, (CoupledBoard, "at"), (Budget, "renew"))
    design = board(kind, 7, 8)
    rest = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.05, 0.05, (7, 8))
    pressed, limited, dead = 0.1 * rest, rest.copy(), rest.copy()
    limited.flat[:49:7] = 5.0
    dead[3] = np.inf
    read = CountReader(design)
    for number, cells in enumerate((rest, pressed, rest, limited, rest, dead, rest)):
        counts = adc_codes(design, scan(design, cells).volts)
        for again in range(9):
            done.clear()
            reading = read(counts)
            if number or again:
                assert done["at"] <= effort.starts + effort.evaluations
                assert done["renew"] <= effort.instalments
            if reading.valid.any():
                off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
                assert (off <= reading.uncertainty[reading.valid]).all()
        if cells is rest:
            assert not (reading.reason == Reason.UNSETTLED).any()


@pytest.mark.parametrize("kind", FLOATING)
def test_a_sudden_event_on_a_floating_board_is_known_within_two_frames(kind: str) -> None:
    """Of more cells than a whole matrix could be renewed for within a frame: all pressed, half pressed, a dead row."""
    design, draw = board(kind, 12, 11), np.random.default_rng(0)
    rest = 1e4 * 10 ** draw.uniform(-0.05, 0.05, (12, 11))
    half, dead = rest.copy(), rest.copy()
    half[:, :5] *= 0.12
    dead[3] = np.inf
    read = CountReader(design)
    for number, cells in enumerate((rest, 0.3 * rest, rest, half, rest, dead, rest)):
        counts = adc_codes(design, scan(design, cells).volts)
        for again in range(4):
            reading = read(counts)
            valid = reading.valid
            assert (np.abs(reading.resistance / cells - 1.0)[valid] <= reading.uncertainty[valid]).all()
            if again > 1 or (again and cells is not rest) or number == 0:
                assert not (reading.reason == Reason.UNSETTLED).any(), (number, again)
                assert (valid == np.isfinite(cells)).all(), (number, again)


@pytest.mark.parametrize(("seed", "noise_steps"), [(24, 12.4), (13, 40.0), (0, 12.4)])
def test_cells_that_noise_has_carried_away_come_back(seed: int, noise_steps: float) -> None:
    """Whole steps from one side of a cell's conductance to the other, and back, would never end (seeds 24 and 13)."""
    design = board("open divider", 8, 8, 10, row_lead=25.0, column_lead=0.0)
    design = design.replace(readout={"reference_resistance": 1e3})
    draw, step = np.random.default_rng(seed), 3.3 / 2**10
    draw.uniform(size=64)
    read, volts = CountReader(design), scan(design, np.full((8, 8), 1e4)).volts
    for noise in [noise_steps] * 10 + [0.1] * 70:
        reading = read(adc_codes(design, volts + draw.normal(scale=noise * step, size=volts.shape)))
    assert reading.all_valid
    assert (np.abs(reading.resistance / 1e4 - 1.0) <= reading.uncertainty).all()


@pytest.mark.parametrize("hard", [0.01, 5.0, 8.0])
@pytest.mark.parametrize("places", [((1, 2),), ((1, 2), (6, 5)), ((1, 2), (4, 2), (6, 5), (3, 7)), ((1, 2), (1, 6))])
@pytest.mark.parametrize("kind", ["divider", "loaded"])
def test_cells_of_a_few_ohm_cost_their_columns_and_rows_that_they_join(kind: str, places: Any, hard: float) -> None:
    """What a cell near a short is, nobody can tell, nor what is beside it in its column. Others stay known."""
    design, draw = board(kind, 9, 10), np.random.default_rng(0)
    rest, columns = 1e4 * 10 ** draw.uniform(-0.05, 0.05, (9, 10)), [column for _, column in places]
    rows = [row for row, _ in places]
    joined = [row for row, column in places if columns.count(column) > 1 or rows.count(row) > 1]
    free = np.ones((9, 10), dtype=np.bool_)
    free[:, columns], free[joined] = False, False
    read = CountReader(design)
    for number in range(16):
        cells = rest.copy()
        if number >= 4:
            cells[tuple(np.transpose(places))] = hard
        if number >= 9:
            cells[6:8, 3:6] = np.minimum(cells[6:8, 3:6], 3e3)  # a finger, in part on lost columns
        reading = read(adc_codes(design, scan(design, cells).volts))
        valid = reading.valid
        assert (np.abs(reading.resistance / cells - 1.0)[valid] <= reading.uncertainty[valid]).all()
        if number == 8 or number >= 12:  # four frames after the events
            assert valid[free].all()


@pytest.mark.parametrize("seed", range(12))
def test_followers_keep_the_rows_that_have_no_saturated_cell(seed: int) -> None:
    """Whatever the saturated cells and their rows are, others stay valid and within their uncertainties.

    The fillings of what nobody can tell are drawn anew after some frames: near a short or not, with any neighbours.
    """
    draw = np.random.default_rng(seed)
    shape, lead = ((8, 8), (12, 10), (16, 16))[seed % 3], (1.0, 25.0, 5.0, 60.0)[seed % 4]
    gain, offset = ((1e5, 0.0), (1e6, 1e-4), (np.inf, 1e-4))[seed // 4]
    readout = {"open_loop_gain": gain, "offset_voltage": (offset * draw.uniform(-1.0, 1.0, shape[1])).tolist()}
    adc = {"bits": (10, 12, 16)[seed % 3], "range": [0.0, (3.3, 2.5)[seed % 2]]}
    design = board("feedback", *shape, row_lead=lead, column_lead=lead).replace(readout=readout, adc=adc)
    rest = 2e4 * 10 ** draw.uniform(-0.1, 0.1, shape)
    places = draw.permutation(shape[0])[:4], draw.permutation(shape[1])[:4]
    free = np.ones(shape, dtype=np.bool_)
    free[places[0]], free[:, places[1]] = False, False
    read = CountReader(design)
    for number in range(30):
        if number % 9 == 3:
            rest[places[0]] = 2e4 * 10 ** draw.uniform(-0.7, 0.7, (4, shape[1]))
            rest[places] = 10 ** draw.uniform(-3.0, 1.0, 4)
        cells = rest * (1.0 - 0.01 * number)
        reading = read(adc_codes(design, scan(design, cells).volts))
        valid = reading.valid
        assert (np.abs(reading.resistance / cells - 1.0)[valid] <= reading.uncertainty[valid]).all()
        if number % 9 == 2 and number > 3:
            assert valid[free].mean() > 0.9


@pytest.mark.parametrize(("noise_steps", "least"), [(0.0, 0.4), (0.2, 0.6), (1.0, 0.8)])
@pytest.mark.parametrize("kind", ["divider", "loaded", "open divider", "feedback", "floating"])
def test_deviations_are_those_of_the_errors(kind: str, noise_steps: float, least: float) -> None:
    """Standard deviations by steps and by noise, together, against the errors of many skins that hold still.

    Errors by steps are half as large as stated where no cells are alike.
    """
    design, draw, squares = board(kind, 6, 7), np.random.default_rng(0), []
    assert design.adc is not None
    for _ in range(8):
        cells, read = 2e4 * 10 ** draw.uniform(-0.3, 0.3, (6, 7)), CountReader(design)
        volts = scan(design, cells).volts
        for _ in range(25):
            noise = draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
            reading = read(adc_codes(design, volts + noise))
        off = reading.resistance / cells - 1.0
        std = reading.uncertainty * np.hypot(reading.steps_std_share, reading.noise_share)
        squares.append((off / std)[reading.valid] ** 2)
        others = np.square(reading.others_noise_std / (reading.uncertainty * reading.noise_share))
        assert others.max() <= 1.0
    assert least < np.sqrt(np.mean(np.concatenate(squares))) < 1.25


@pytest.mark.parametrize("noise_steps", [0.0, 0.2, 0.4])
def test_deviations_are_those_of_errors_that_are_alike(noise_steps: float) -> None:
    """Cells at rest round alike. In a pressed column the sum of their errors counts."""
    design, draw, squares = board("divider", 6, 10, bits=8), np.random.default_rng(0), []
    assert design.adc is not None
    for _ in range(40):
        cells, read = np.full((6, 10), draw.uniform(25e3, 35e3)), CountReader(design)
        cells[2:5, 6] = draw.uniform(850.0, 1300.0)
        volts = scan(design, cells).volts
        for _ in range(25):
            noise = draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
            reading = read(adc_codes(design, volts + noise))
        off = (reading.resistance / cells - 1.0)[2:5, 6]
        std = (reading.uncertainty * np.hypot(reading.steps_std_share, reading.noise_share))[2:5, 6]
        squares.append((off / std)[reading.valid[2:5, 6]] ** 2)
    assert 0.5 < np.sqrt(np.mean(np.concatenate(squares))) < 1.25


@pytest.mark.parametrize(
    ("rows", "bits", "reference_ohm"), [(16, 10, 30e3), (16, 8, 10e3), (32, 12, 30e3), (32, 10, 10e3)]
)
@pytest.mark.parametrize("kind", ["divider", "loaded"])
def test_equal_cells_that_round_alike_are_nearly_as_certain_as_stated(
    kind: str, rows: int, bits: int, reference_ohm: float
) -> None:
    """As on an emulated skin without noise: all readings of a column are off by the same part of a step.

    An uncertainty is that of a logarithm, and the scale of a column s / (1 - S): at the limit of validity this may
    exceed it by a half, which is no factor of two.
    """
    design = board(kind, rows, 3, bits, row_lead=0.0, column_lead=0.0)
    design, used = design.replace(readout={"reference_resistance": reference_ohm}), []
    for level in np.geomspace(0.5, 2.0, 60):
        read, cells = CountReader(design), np.full((rows, 3), level * 1e4)
        for number in range(9):
            if number == 6:
                cells[rows // 3 : rows // 3 + 2, 1] *= 1.5  # a finger
            reading = read(adc_codes(design, scan(design, cells).volts))
            off = np.abs(reading.resistance / cells - 1.0) / reading.uncertainty
            used.append(np.max(off, where=reading.valid, initial=0.0))
    assert np.count_nonzero(used) > 200
    assert max(used) < 1.5


@pytest.mark.parametrize("kind", ["divider", "loaded"])
@pytest.mark.parametrize("share", [0.9, 0.8, 0.7])
def test_the_scale_of_a_column_is_not_more_certain_by_derivatives_of_lighter_loads(kind: str, share: float) -> None:
    """Readings tell less of a column the nearer it is to the drive, whatever cells the derivatives are from."""
    design = board(kind, 16, 12).replace(readout={"reference_resistance": 20e3})
    rest = 1e4 * np.exp(np.random.default_rng(0).normal(0.0, 0.1, (16, 12)))
    at_rest, pressed = (adc_codes(design, scan(design, cells).volts) for cells in (rest, share * rest))
    went_on, anew = CountReader(design), CountReader(design)
    for counts in [at_rest] * 30 + [pressed] * 30:
        reading = went_on(counts)
    for _ in range(30):
        expected = anew(pressed)
    assert reading.all_valid
    assert (reading.uncertainty > 0.97 * expected.uncertainty).all()


SHORT = {"kind": "shorted-cell", "place": [1, 1], "resistance": 0.0}
BROKEN_ROW = {"kind": "broken-row", "place": [1, 2]}
BROKEN_COLUMN = {"kind": "broken-column", "place": [1, 2]}


@pytest.mark.parametrize(
    ("kind", "fault", "known"),
    [
        ("grounded", SHORT, 25),
        ("grounded", BROKEN_ROW, 32),
        ("grounded", BROKEN_COLUMN, 34),
        ("divider", SHORT, 25),
        ("feedback", SHORT, 35),
        ("feedback", BROKEN_ROW, 32),
    ],
)
@pytest.mark.parametrize("segment", [0.0, 0.5])
def test_a_complete_fault_hides_no_more_than_its_line(kind: str, fault: Any, known: int, segment: float) -> None:
    design = board(kind, 6, 6, row_segment=segment, column_segment=segment, fault=[fault])
    cells = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.1, 0.1, (6, 6))
    read = CountReader(design)
    for _ in range(8):
        cells[2, 3] *= 0.9
        reading = read(adc_codes(design, scan(design, cells).volts))
        valid = reading.valid
        assert valid.sum() >= known
        off = np.abs(reading.resistance / cells - 1.0)[valid]
        assert (off <= reading.uncertainty[valid]).all()
        assert not valid[1, 1] or fault["kind"] != "shorted-cell"


@pytest.mark.parametrize("kind", ["grounded", "divider", "feedback", "floating"])
def test_a_continuous_sheet_is_solved_once_per_frame(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    solved = [0]
    real = _sheet_model.SheetModel.solve

    def counting(self: _sheet_model.SheetModel, log: Any) -> None:
        solved[0] += 1
        real(self, log)

    monkeypatch.setattr(_sheet_model.SheetModel, "solve", counting)
    design = board(kind, 4, 5, sheet="continuous")
    cells = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.1, 0.1, (4, 5))
    read = CountReader(design)
    for number in range(6):
        cells[1:3, 2] *= 0.8 if number != 3 else 0.2  # a hard press at once
        solved[0] = 0
        reading = read(adc_codes(design, scan(design, cells).volts))
        assert number == 0 or solved[0] <= 1
        valid = reading.valid
        assert (np.abs(reading.resistance / cells - 1.0)[valid] <= reading.uncertainty[valid]).all()
        if number != 3:
            assert valid.mean() > 0.7


@pytest.mark.parametrize("kind", ["divider", "feedback", *FLOATING])
def test_a_large_board_needs_no_matrix(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """More cells than a matrix of all readings by all cells could serve: every step does without it."""
    monkeypatch.setattr(_linearised, "LARGEST_BESIDE", 100)
    monkeypatch.setattr(_linearised, "LARGEST_MATRIX", 100)
    monkeypatch.setattr(_linearised, "NormalMatrix", None)
    design, draw = board(kind, 12, 14, 16), np.random.default_rng(0)
    read, rest = CountReader(design), 1e4 * 10 ** draw.uniform(-0.05, 0.05, (12, 14))
    for share in (1.0, 0.7, 0.7, 0.3, 0.3, 0.3, 1.0, 1.0, 1.0):
        cells = rest.copy()
        cells[3:8, 4:9] *= share
        reading = read(adc_codes(design, scan(design, cells).volts))
        valid = reading.valid
        assert (np.abs(reading.resistance / cells - 1.0)[valid] <= reading.uncertainty[valid]).all()
    assert valid.all()


def test_a_bridged_board_that_is_too_large_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_linearised, "LARGEST_MATRIX", 110)
    bridge = {"kind": "bridged-rows", "place": [2, 3], "resistance": 50.0}
    with pytest.raises(InputError, match="at most 110 cells"):
        CountReader(board("floating", 11, 11, fault=[bridge]))
    CountReader(board("floating", 11, 11))
    CountReader(board("divider", 11, 11))


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"grounded"}))
def test_the_first_frame_that_tells_of_cells_has_a_usual_budget(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A skin that is opened under a load which brings all readings to a limit, and is then let go."""
    done = counted(monkeypatch, (CoupledBoard, "at"), (Budget, "renew"))
    design, most = board(kind, 7, 8), ANEW_EFFORT
    rest = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.05, 0.05, (7, 8))
    read = CountReader(design)
    assert not read(adc_codes(design, scan(design, np.full((7, 8), 1e-2)).volts)).valid.any()
    counts = adc_codes(design, scan(design, rest).volts)
    evaluations = 0
    for _ in range(12):
        done.clear()
        reading = read(counts)
        evaluations += done["at"]
        assert done["at"] <= most.starts + most.evaluations
        assert done["renew"] <= most.instalments
    assert evaluations > 0
    assert reading.valid.all()
    assert (np.abs(reading.resistance / rest - 1.0) <= reading.uncertainty).all()


@pytest.mark.parametrize(("family", "number"), [("feedback events", 91010000156), ("floating events", 91020000084)])
def test_a_skin_that_comes_off_a_limit_takes_no_slow_frame(family: str, number: int) -> None:
    """Executed lines of two streams of the hunt, in which the first frame to tell of a cell is a late one."""
    tally = _live_hunt.LiveTally()
    _live_hunt.check(family, number, tally)
    assert tally.slow == []
    assert tally.findings == []
    assert tally.valid > 0


@pytest.mark.parametrize(
    "stream",
    [
        "loaded twofold:170000153",  # right readings were called unsolved
        "divider twofold:170000248",
        "divider twofold:170000369",
        "divider twofold:170000659",
        "loaded twofold:170000973",
        "open loaded twofold:170000042",  # floating rows
        "loaded twofold:170000198",  # a column that was left out too long kept the others from settling
        "divider twofold:170000236",  # steps by which the cells never came near
        "loaded twofold:170000355",
    ],
)
def test_steps_that_lead_nowhere_are_given_up_for_another_start(stream: str) -> None:
    """After columns of a few ohm, the cells exist, and nothing valid is wrong on the way there.

    The streams settle with every rounding of the linear algebra: tried with OPENBLAS_CORETYPE=Haswell, Zen, SkylakeX
    and Sandybridge.
    """
    family, number = stream.split(":")
    tally = _live_hunt.LiveTally()
    _live_hunt.check(family, int(number), tally)
    assert tally.findings == []
    assert tally.valid
