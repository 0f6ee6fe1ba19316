"""Amplifier boards at their limits: leads as large as the cells, shorts beside offsets, streams once read wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import inf
from typing import Any

import numpy as np
import pytest

from ohmskin.bench import _live_hunt
from ohmskin.circuits import Design, Reason, adc_codes, scan
from ohmskin.circuits.recovery import _amplified_leads, _heavy_leads
from ohmskin.circuits.recovery._amplified import AmplifiedLive
from ohmskin.circuits.recovery._amplified_board import AmplifiedBoard
from ohmskin.circuits.recovery._amplified_leads import LeadBases
from ohmskin.circuits.recovery._amplified_limits import CellsAtLimits
from ohmskin.circuits.recovery._amplified_prices import AmplifiedPrices
from ohmskin.circuits.recovery._frame_account import Account
from ohmskin.circuits.recovery._heavy_leads import LeadFit, invert_leads
from ohmskin.circuits.solvers import FrameTransfer, Lines, exact_transfer
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader


def board(rows: int, columns: int, lead: float, *, bits: int = 12, segment: float = 0.0, **readout: Any) -> Design:
    lines = {"row_lead": lead, "column_lead": lead, "row_segment": segment, "column_segment": segment}
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns} | lines,
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "inverting-amplifier", "reference_resistance": 1e3} | readout,
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )


@pytest.mark.parametrize("shape", [(2, 2), (3, 7), (8, 8), (16, 5)])
@pytest.mark.parametrize(("lead", "least_ohm"), [(0.0, 1.0), (5.0, 50.0), (100.0, 150.0), (100.0, 1e3)])
def test_cells_of_any_leads_follow_from_exact_transfer_conductances(
    shape: tuple[int, int], lead: float, least_ohm: float
) -> None:
    conductance, row_ohm, column_ohm, transfer = leads_at_random(shape, lead, least_ohm)
    fit = fitted(transfer, row_ohm, column_ohm, transfer)
    assert fit.settled
    np.testing.assert_allclose(fit.conductance, conductance, rtol=1e-5)


def leads_at_random(
    shape: tuple[int, int], lead: float, least_ohm: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Conductances, ohm of rows and of columns, and exact transfer conductances."""
    rng = np.random.default_rng(shape[0])
    conductance = 1.0 / (least_ohm * 10 ** rng.uniform(0, 1, shape))
    row_ohm, column_ohm = lead * rng.uniform(0.5, 1.5, shape[0]), np.full(shape[1], max(lead, 0.01))
    row, column = np.full(shape, np.inf), np.full(shape, np.inf)
    with np.errstate(divide="ignore"):
        row[:, 0] = 1.0 / row_ohm
    return conductance, row_ohm, column_ohm, exact_transfer(conductance, Lines(row, column, 1.0 / column_ohm))[0]


def fitted(transfer: FloatArray, row_ohm: FloatArray, column_ohm: FloatArray, start: FloatArray) -> LeadFit:
    fit = None
    for _ in range(3):  # as frames go on from the last one
        fit = invert_leads(transfer, transfer * column_ohm, row_ohm, column_ohm, start)
        assert fit is not None
        start = fit.conductance
    assert fit is not None
    return fit


@pytest.mark.parametrize(
    ("shape", "lead", "least_ohm"), [((3, 4), 100.0, 150.0), ((6, 2), 50.0, 30.0), ((4, 5), 10.0, 200.0)]
)
def test_errors_of_readings_come_through_heavy_leads_as_by_inverting_twice(
    shape: tuple[int, int], lead: float, least_ohm: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    conductance, row_ohm, column_ohm, transfer = leads_at_random(shape, lead, least_ohm)
    fit, small = fitted(transfer, row_ohm, column_ohm, transfer), 1e-4 * float(transfer.mean())
    expected, variance = np.zeros(shape), np.zeros(shape)
    for place in np.ndindex(shape):
        moved = transfer.copy()
        moved[place] += small
        change = fitted(moved, row_ohm, column_ohm, conductance).conductance - fit.conductance
        expected, variance = expected + np.abs(change), variance + change**2
    found = fit.propagation(exactly=True)
    np.testing.assert_allclose(found(np.full(shape, small)), expected, rtol=0.02)
    np.testing.assert_allclose(found.squared()(np.full(shape, small**2)), variance, rtol=0.04)
    bound = fit.propagation(exactly=False)(np.full(shape, small))
    assert (bound >= 0.98 * expected).all()
    assert (bound <= 10.0 * expected).all() or lead > least_ohm  # bounds without cancelling may be infinite there


@pytest.mark.parametrize("shape", [(12, 12), (9, 28), (28, 9)])
def test_single_precision_is_enough_for_errors(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    _, row_ohm, column_ohm, transfer = leads_at_random(shape, 100.0, 150.0)
    fit, readings = fitted(transfer, row_ohm, column_ohm, transfer), np.full(shape, 1e-9)
    single = fit.propagation(exactly=True)
    monkeypatch.setattr(_heavy_leads, "MOST_IN_DOUBLE", shape[0] * shape[1])
    double = fit.propagation(exactly=True)
    np.testing.assert_allclose(single(readings), double(readings), rtol=1e-3)
    np.testing.assert_allclose(single.squared()(readings), double.squared()(readings), rtol=1e-3)


@pytest.mark.parametrize(("number", "apart"), [(np.float32, 1e-6), (np.float64, 1e-14)])
def test_solutions_that_rounding_decides_are_infinite(number: type, apart: float) -> None:
    draw = np.random.default_rng(0)
    matrix = draw.uniform(-1.0, 1.0, (9, 9)) + 5.0 * np.eye(9)
    expected = np.linalg.inv(matrix)
    found = _heavy_leads._solution(matrix.astype(number, order="F"), np.eye(9, dtype=number, order="F"))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    matrix[:, 3] = matrix[:, 4] * (1.0 + apart * draw.uniform(size=9))
    found = _heavy_leads._solution(matrix.astype(number, order="F"), np.eye(9, dtype=number, order="F"))
    assert np.isinf(found).all()


@pytest.mark.parametrize("segment", [0.0, 3.0])
def test_currents_of_unlike_offsets_are_taken_out_exactly(segment: float) -> None:
    design = board(4, 3, 30.0, segment=segment, offset_voltage=[3e-3, -2e-3, 1e-3], open_loop_gain=1e3)
    cells = 10 ** np.random.default_rng(0).uniform(1.5, 2.5, (4, 3))
    amplified = AmplifiedBoard(design.board)
    current = scan(design, cells).volts * amplified.scale + amplified.constant
    checked = LeadBases(amplified, AmplifiedPrices(amplified))._checked(current, 1.0 / cells, Account(inf))
    assert checked is not None
    _, transfer, apart = checked
    assert np.abs(apart / transfer).max() < 1e-12


def test_rows_that_shorts_join_are_not_told_apart() -> None:
    """A column of shorts: every row has the potential of that column, and other cells would give the same readings."""
    design = board(4, 3, 100.0).replace(array={"row_lead": 0.5})
    cells = np.full((4, 3), 700.0)
    cells[:, 1] = 0.01
    read = CountReader(design)
    for _ in range(6):
        reading = read(adc_codes(design, scan(design, cells).volts))
        off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
        assert (off <= reading.uncertainty[reading.valid]).all()
    assert not reading.valid[:, 1].any()


@pytest.mark.parametrize("segment", [0.0, 0.5])
@pytest.mark.parametrize("noise_steps", [0.0, 1.0])
def test_cells_like_their_leads_are_read_in_every_frame(segment: float, noise_steps: float) -> None:
    """A multiplexer's 100 ohm on both ends, and a hand that presses all cells of 3 kohm to a few hundred ohm."""
    design, rng = board(6, 6, 100.0, segment=segment), np.random.default_rng(7)
    read, rest = CountReader(design), 3e3 * np.exp(rng.normal(0, 0.1, (6, 6)))
    assert design.adc is not None
    unsettled = 0
    for number, share in enumerate(np.r_[np.linspace(0, 1, 20), np.ones(10)]):
        cells = rest / (1.0 + 9.0 * share * rng.uniform(0.9, 1.0, (6, 6)))
        volts = scan(design, cells).volts + rng.normal(scale=noise_steps * design.adc.step, size=(6, 6))
        reading = read(adc_codes(design, volts))
        found = reading.valid
        off = np.abs(reading.resistance / cells - 1.0)[found] / reading.uncertainty[found]
        assert off.max(initial=0.0) <= (1.0 + 1e-9 if not noise_steps else 5.0 / 3.0)
        if number > 1:
            unsettled += int((reading.reason == Reason.UNSETTLED).any())
            assert found.mean() > 0.9
    assert unsettled <= 2


def test_two_shorts_on_a_row_join_columns_of_unequal_offsets() -> None:
    """The difference of 4 mV drives a current like a cell's through both shorts, in every step."""
    design = board(4, 3, 10.0, offset_voltage=[2e-3, -2e-3, 0.0], supply=[-0.2, 3.3]).replace(
        adc={"range": [-0.1, 3.3]}
    )
    rng, read = np.random.default_rng(3), CountReader(design)
    seen = 0
    for _ in range(20):
        cells = 10 ** rng.uniform(3.0, 3.3, (4, 3))
        cells[2, :2] = rng.uniform(0.01, 3.0, 2)
        reading = read(adc_codes(design, scan(design, cells).volts))
        found = reading.valid
        off = np.abs(reading.resistance / cells - 1.0)[found]
        assert (off <= reading.uncertainty[found] + 1e-9).all()
        seen += int(found.sum())
    assert seen > 10


def test_two_shorts_on_a_row_share_the_currents_of_their_columns() -> None:
    """The amplifiers' inputs are like the shorts, so a current of the one column returns half through the other."""
    design = board(4, 4, 0.0, open_loop_gain=1e3, supply=[-0.2, 3.3]).replace(array={"row_lead": 100.0})
    cells = 10 ** np.random.default_rng(5).uniform(3.0, 4.0, (4, 4))
    untouched = CountReader(design)(adc_codes(design, scan(design, cells).volts))
    cells[2, :2] = 0.01
    reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
    off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
    assert (off <= reading.uncertainty[reading.valid] + 1e-9).all()
    assert untouched.valid.all()
    assert reading.valid[[0, 1, 3], 2:].all()


def test_a_cell_below_the_range_draws_its_columns_source() -> None:
    """The offset drives a current through all cells of a column in every step, also through those that are not read."""
    design = board(5, 3, 1.0, bits=16, offset_voltage=[4e-3, -4e-3, 0.0], supply=[-0.1, 2.9])
    design = design.replace(adc={"range": [0.2, 3.1]}, readout={"reference_resistance": 5e4})
    cells = np.full((5, 3), 6e4)
    cells[:3, 0] = cells[1:, 1] = 3e5
    reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
    off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
    assert reading.valid.sum() == 8
    assert (off <= reading.uncertainty[reading.valid]).all()


def test_what_an_offset_pushes_below_the_range_may_conduct_up_to_the_range() -> None:
    """Outputs below 0 V read as hardly a current, but their cells load a column with a heavy lead."""
    design = board(6, 1, 0.4, bits=20, open_loop_gain=300.0, offset_voltage=-9e-5).replace(array={"column_lead": 1e3})
    pressed = np.array([[1e6], [44.0], [150.0], [2.5e5], [110.0], [7.8e3]])
    for least in (1e6, np.inf):
        cells = np.where(pressed < 1e5, pressed, least)
        reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
        off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
        assert reading.valid.ravel().tolist() == [False, True, True, False, True, True]
        assert (reading.reason[~reading.valid] == Reason.NO_CURRENT).all()
        assert (off <= reading.uncertainty[reading.valid]).all()


@pytest.mark.parametrize("bits", [12, 16, 18, 24])
@pytest.mark.parametrize("offset_steps", [0.0, -2.5, 2.5])
def test_an_output_at_a_limit_is_never_a_measurement(bits: int, offset_steps: float) -> None:
    """The swing ends within the converter's range, whose lower end is above 0 V; the converter has an offset, too."""
    design = board(3, 4, 5.0, bits=bits, supply=[-0.1, 2.9]).replace(adc={"range": [0.2, 3.1]})
    assert design.adc is not None
    design = design.replace(adc={"offset_voltage": offset_steps * design.adc.step})
    cells = np.full((3, 4), 1e3)
    cells[0, 1], cells[2, 3] = 100.0, 1e5  # beyond the swing, and below the range
    for _ in range(2):
        reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
        assert not reading.valid[0, 1]
        assert not reading.valid[2, 3]
        assert reading.reason[0, 1] == Reason.SATURATED
        assert reading.valid[1, 0]


@pytest.mark.parametrize("noise_steps", [0.0, 0.5, 2.0])
@pytest.mark.parametrize(
    ("circuit", "supply", "level", "voltage"),
    [
        ("inverting-amplifier", [0.0, 3.4], 0.0, -1.0),
        ("row-amplifier", [0.0, 3.4], 0.0, -1.0),
        ("row-amplifier", [0.1, 3.4], 0.1, -0.8),
        ("inverting-amplifier", [-0.1, 3.0], 3.0, 1.0),
        ("voltage-feedback", [0.0, 3.4], 0.0, 1.0),
    ],
)
def test_an_open_cell_whose_output_an_offset_holds_at_its_limit_is_never_a_measurement(
    circuit: str, supply: list[float], level: float, voltage: float, noise_steps: float
) -> None:
    """As of amplifiers on a single supply: noise moves the reading away from the limit as a current would."""
    design = board(6, 5, 5.0, bits=14, circuit=circuit, supply=supply, reference_voltage=level, open_loop_gain=1e5)
    away = -5e-3 if level < 1.0 else 5e-3
    design, draw = (
        design.replace(drive={"voltage": voltage}, readout={"offset_voltage": away}),
        np.random.default_rng(3),
    )
    assert design.adc is not None
    cells = 1e4 * 10 ** draw.uniform(-0.1, 0.1, (6, 5))
    cells[2, 3] = cells[4, 0] = inf
    read, volts = CountReader(design), scan(design, cells).volts
    for number in range(40):
        noise = draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
        reading = read(adc_codes(design, volts + noise))
        assert not reading.valid[np.isinf(cells)].any()
        if number > 4:
            assert reading.valid[np.isfinite(cells)].all()


@pytest.mark.parametrize("bits", [18, 20, 24])
@pytest.mark.parametrize("noise_volts", [1e-6, 8e-6, 2e-5])
def test_noise_of_fine_converters_brings_no_saturated_output_back_to_life(bits: int, noise_volts: float) -> None:
    """From the first frame on, in which nobody knows that the noise is many steps: up to 100 of 24 bits."""
    design = board(4, 3, 50.0, bits=bits, supply=[-0.1, 2.9])
    cells, draw = np.full((4, 3), 2e3), np.random.default_rng(bits)
    cells[1, 1] = cells[3, 1] = 60.0  # beyond the swing: each would be read as one that just reaches the limit
    volts = scan(design, cells).volts
    assert (volts[[1, 3], 1] == 2.9).all()
    for _ in range(30):
        read = CountReader(design)
        for _ in range(4):
            reading = read(adc_codes(design, volts + draw.normal(scale=noise_volts, size=volts.shape)))
            assert not reading.valid[[1, 3], 1].any()
    assert reading.valid[0, 0]


@pytest.mark.parametrize(
    "stream",
    [
        "inverting:210000031",  # leads like the cells: did not settle
        "inverting:210000308",
        "inverting:310000132",
        "inverting:310000557",
        "row:210000527",  # the same, and off by a factor of two
        "inverting:310000464",  # offsets through a cell whose drive a short takes: open cells seemed to conduct
        "inverting:210000679",  # two shorts on a row: off by a factor of two
        "inverting:93010000031",  # other columns feed a short's row: an open cell was off by a factor of two
        "inverting:910000697",  # two columns joined by shorts on two rows: off by a factor of two
        "row:910000038",  # heavy leads whose amplifiers have unlike offsets
        "row events:5010000145",  # cells at the low end feed other rows by way of a broken column
        "inverting events:3010000006",  # 18 bits: limits were not seen
        "inverting events:3010000024",  # cells below the range beside heavy leads
        "inverting events:3010000026",  # an offset through cells below the range
        "inverting events:3010000074",  # a whole row of shorts joins all columns
        "inverting events:3010000119",  # a whole column of shorts joins all rows
        "inverting events:3010000137",
        "inverting events:3010000151",  # did not settle, and was called known to a half
        "row events:3050000679",  # heavy leads behind segments, with unlike offsets
        "inverting events:3060000369",
        "inverting:3060000153",  # a known short in the column of a saturated cell
        "inverting events:3030000911",  # noise that takes an output at its limit back into the range
        "row events:3020000137",  # a line shorted in mid-stream
        "inverting events:555000002",  # noise that begins, and takes an output at its limit back into the range
        "row extremes:202010000038",  # the same with a converter of 6 bits: off by a factor of 60
        "inverting extremes:202020000095",
        "inverting extremes:201010000046",  # cells shorted in the frame in which a noise begins
        "inverting extremes:201050000042",  # open cells whose outputs an offset pushes far below the range
        "inverting extremes:97950000151",  # 24 bits: noise from the first frame on takes an output off its limit
        "row extremes:97950000168",
    ],
)
def test_streams_that_were_once_misread(stream: str) -> None:
    family, number = stream.split(":")
    tally = _live_hunt.LiveTally()
    _live_hunt.check(family, int(number), tally)
    assert tally.findings == []


@pytest.mark.parametrize(
    "stream",
    [
        "inverting:6120000145",  # a fit that had not come to its end, called certain by its derivatives
        "row:50000086",  # heavy leads and segments beside a cell of 1 ohm
    ],
)
def test_streams_on_which_no_iteration_comes_to_an_end_have_no_wrong_cell(stream: str) -> None:
    """Shorts behind heavy leads with segments: Kirchhoff's laws without segments lead round in a circle."""
    family, number = stream.split(":")
    tally = _live_hunt.LiveTally()
    _live_hunt.check(family, int(number), tally)
    assert tally.count("wrong cell") == tally.count("factor of two") == tally.count("unsolved") == 0


def test_currents_between_columns_are_those_of_the_frame() -> None:
    """Sources differ, so columns exchange current by way of the rows: less of it when the whole skin is released."""
    draw, shape = np.random.default_rng(0), (32, 32)
    design = Design.model_validate(
        {
            "array": {"rows": 32, "columns": 32, "row_lead": 50.0},
            "drive": {"voltage": -1.0},
            "readout": {
                "circuit": "inverting-amplifier",
                "reference_resistance": 10e3,
                "open_loop_gain": 1e5,
                "offset_voltage": draw.uniform(-5e-3, 5e-3, 32).tolist(),
            },
            "adc": {"bits": 12, "range": [-0.5, 5.0]},
        }
    )
    read, pattern = CountReader(design), draw.uniform(0.9, 1.1, shape)
    for ohms in (15e3, 15e3, 9e3, 9e3, 16e3, 16e3, 7e3, 14e3):
        reading = read(adc_codes(design, scan(design, ohms * pattern).volts))
        assert reading.valid.all()
        assert (np.abs(reading.resistance / (ohms * pattern) - 1.0) <= reading.uncertainty).all()


@pytest.mark.parametrize("column_segment", [0.0, 0.5])
def test_currents_between_columns_are_known_where_rows_take_most_of_the_drive(column_segment: float) -> None:
    draw, shape = np.random.default_rng(1), (32, 32)
    offsets = draw.uniform(-5e-3, 5e-3, 32).tolist()
    lines = {"row_lead": 50.0, "row_segment": 2.0, "column_segment": column_segment}
    design = Design.model_validate(
        {
            "array": {"rows": 32, "columns": 32} | lines,
            "drive": {"voltage": -1.0},
            "readout": {
                "circuit": "inverting-amplifier",
                "reference_resistance": 1e3,
                "offset_voltage": offsets,
            },
            "adc": {"bits": 16, "range": [-0.5, 5.0]},
        }
    )
    read, cells = CountReader(design), 10 ** draw.uniform(3.0, 3.5, shape)
    counts = adc_codes(design, scan(design, cells).volts)
    for _ in range(4):
        reading = read(counts)
        used = np.abs(reading.resistance / cells - 1.0)[reading.valid] / reading.uncertainty[reading.valid]
        assert used.size
        assert used.max() <= 1.0


def test_a_frame_that_tells_of_no_cell_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    design = board(5, 4, 100.0, bits=10)
    rest, read = np.full((5, 4), 2e4), CountReader(design)
    for _ in range(3):
        expected = read(adc_codes(design, scan(design, rest).volts))
    assert expected.valid.all()

    def worked_out(*_: Any) -> Any:
        raise AssertionError("all readings are at a limit")

    with monkeypatch.context() as unused:
        unused.setattr(AmplifiedLive, "_cells", worked_out)
        found = read(np.full((5, 4), 1023))
        assert (found.reason == Reason.SATURATED).all()
        assert not found.valid.any()
        assert np.isnan(found.resistance).all()
        assert np.isinf(found.uncertainty).all()
    for _ in range(6):
        found = read(adc_codes(design, scan(design, rest).volts))
    np.testing.assert_allclose(found.resistance, expected.resistance, rtol=0.01)
    assert found.valid.all()


class Work:
    """What frames really do, by calls of the models, at the prices of the board."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.done: Counter[str] = Counter()
        self._inside = 0
        self._count(patch, FrameTransfer, "attenuated", "attenuation")
        self._count(patch, FrameTransfer, "exact", "exact")
        self._count(patch, FrameTransfer, "ports", "exact")
        self._count(patch, _amplified_leads, "invert_leads", "round", lambda fit: 0 if fit is None else fit.rounds)
        self._count(patch, LeadFit, "_derivatives", "derivatives")
        self._count(patch, LeadFit, "_inverses", "bounds")

    def _count(
        self, patch: pytest.MonkeyPatch, owner: Any, name: str, what: str, number: Callable[[Any], int] = lambda _: 1
    ) -> None:
        real = getattr(owner, name)

        def counting(*given: Any, **named: Any) -> Any:
            self._inside += 1
            found = real(*given, **named)
            self._inside -= 1
            self.done[what] += 0 if self._inside else number(found)  # an exact evaluation may be part of another one
            return found

        patch.setattr(owner, name, counting)

    def price(self, prices: AmplifiedPrices) -> float:
        """Of what has been done since the last call."""
        price = sum(getattr(prices, what) * count for what, count in self.done.items())
        self.done.clear()
        return price


@pytest.mark.parametrize(
    ("shape", "lead", "segment", "press"),
    [((9, 7), 130.0, 0.0, 40.0), ((9, 7), 130.0, 0.5, 40.0), ((16, 16), 70.0, 0.1, 10.0), ((24, 24), 70.0, 0.1, 10.0)],
)
def test_a_press_that_makes_leads_heavy_is_worked_out_within_the_account_of_each_frame(
    shape: tuple[int, int], lead: float, segment: float, press: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All cells are pressed at once, held, and released; 24 x 24 cells took five times as much in a frame."""
    work, draw = Work(monkeypatch), np.random.default_rng(3)
    design = board(*shape, lead, bits=14, segment=segment, offset_voltage=1e-3)
    rest = 2e4 * 10 ** draw.uniform(-0.2, 0.2, shape)
    read, valid, heavy = CountReader(design), [], False
    assert isinstance(read._recover, AmplifiedLive)
    prices = read._recover._prices
    for number in range(22):
        cells = (rest / press if 4 <= number < 12 else rest) * (1.0 + 1e-3 * number)
        found = read(adc_codes(design, scan(design, cells).volts))
        done, heavy = work.price(prices), heavy or read._recover._heavy
        assert number == 0 or done <= prices.most(heavy=False)
        error = np.abs(found.resistance / cells - 1.0)
        assert (error <= found.uncertainty)[found.valid].all()
        valid.append(bool(found.valid.all()))
        assert found.valid.all() or (found.reason[~found.valid] == Reason.UNSETTLED).all()
    assert heavy
    assert all(valid[8:12]), "a press that is held is valid after four frames"
    assert all(valid[18:])


def test_what_thousands_of_shorts_would_do_is_left_open() -> None:
    """Half of the readings at a limit: to enclose what they make of the others took 20 usual frames of 64 x 64."""
    parts = AmplifiedBoard(board(64, 64, 20.0, segment=0.1).board)
    prices = AmplifiedPrices(parts)
    at_limits, draw = CellsAtLimits(parts, prices), np.random.default_rng(0)
    cells = 1e-4 * 10 ** draw.uniform(-0.2, 0.2, (64, 64))
    for share, left_open in ((0.01, False), (0.95, True)):
        limited = draw.random(cells.shape) < share
        account = Account(prices.most(heavy=False))
        found = at_limits(cells, np.where(limited, 3.3, 1.0), limited, 1e-4, None, account)
        assert np.isinf(found).all() == left_open
        assert account.left >= 0.0
