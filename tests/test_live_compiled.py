"""Loops of the live path as machine code: the same cells, uncertainties and reasons as array operations give."""

from __future__ import annotations

from typing import Any, get_type_hints

import numpy as np
import pytest

from ohmskin.bench import _driver as bench
from ohmskin.bench import _live_streams
from ohmskin.cell import Cell
from ohmskin.circuits import Design, adc_codes, live_recovery, scan
from ohmskin.circuits.readouts import QuickNetwork, _quick
from ohmskin.circuits.recovery._amplified import AmplifiedLive
from ohmskin.circuits.recovery._amplified_loops import UsualFrames
from ohmskin.circuits.recovery._heavy_leads import MOST_IN_DOUBLE
from ohmskin.common import compiled
from ohmskin.common.compiled import Loop
from ohmskin.driver import CountReader
from ohmskin.driver._reading import Reading
from ohmskin.driver._systematic import SystematicError

CLOSE = 1e-11
"""relative: sums over cells are added up in another order"""
CLOSE_MISFIT = 1e-8
"""the same of uncertainties on coupled boards: a misfit between readings and model counts, though it is all rounding"""
CLOSE_IN_SINGLE = 1e-3
"""the same where leads are heavy and derivatives are made in single precision"""
ROUNDED = 1e-13
"""a few hundred ulp of the conductance that a relative uncertainty refers to"""
FRAMES = 60

pytestmark = pytest.mark.skipif(compiled.why_not() is not None, reason="the extra 'fast' is not in use")


class Pair:
    """Two readers of one board, one with machine code, and the frames that the loops served."""

    def __init__(self, design: Design, monkeypatch: pytest.MonkeyPatch) -> None:
        self.served = 0
        self.close = CLOSE_MISFIT
        self.loops = CountReader(design)
        self.systematic = SystematicError(Cell.example())
        with monkeypatch.context() as without:
            without.setenv(compiled.SWITCH, "0")
            self.arrays = CountReader(design)
            self.reference = SystematicError(Cell.example())
        if isinstance(self.loops._recover, AmplifiedLive):
            in_single = design.array.rows * design.array.columns > MOST_IN_DOUBLE
            self.close = CLOSE_IN_SINGLE if in_single and self.loops._recover._board.lead_like else CLOSE
            self._count(self.loops._recover._loops, monkeypatch)
            # Ladders in both: the closed form of array operations is compared in test_frame_transfer.py.
            assert isinstance(self.arrays._recover, AmplifiedLive)
            self.arrays._recover._board.models._uniform = None

    def _count(self, loops: UsualFrames, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("about", "independent"):
            serve = getattr(loops, name)

            def counted(*arguments: Any, serve: Any = serve) -> Any:
                found = serve(*arguments)
                self.served += found is not None
                return found

            monkeypatch.setattr(loops, name, counted)

    def read(self, counts: Any) -> tuple[Reading, Reading]:
        """What both find in a frame, after comparing it."""
        found, expected = self.loops(counts), self.arrays(counts)
        np.testing.assert_array_equal(found.reason, expected.reason)
        np.testing.assert_array_equal(found.valid, expected.valid)
        np.testing.assert_allclose(found.resistance, expected.resistance, rtol=CLOSE)
        # An uncertainty may hold the difference of a reading and an exact solution, which both round otherwise.
        np.testing.assert_allclose(found.uncertainty, expected.uncertainty, rtol=self.close, atol=ROUNDED)
        np.testing.assert_allclose(found.own_uncertainty, expected.own_uncertainty, rtol=self.close)
        # A difference of uncertainties, off by as much as these may be off: where nearly all is the cell's own part,
        # the rest is much smaller than its rounding.
        known = np.isfinite(expected.uncertainty)
        rounded = self.close * expected.uncertainty[known] + ROUNDED
        off = np.abs(found.others_noise_std - expected.others_noise_std)
        assert (off[known] <= rounded).all()
        assert not off[~known].any()
        np.testing.assert_allclose(found.step_std, expected.step_std, rtol=self.close)
        assert (found.solved, found.all_valid) == (expected.solved, expected.all_valid)
        assert self.loops.noise_volts == pytest.approx(self.arrays.noise_volts, rel=CLOSE)
        return found, expected


@pytest.mark.slow
@pytest.mark.parametrize("family", ["inverting", "row", "inverting events", "row events", "divider", "feedback events"])
def test_streams_of_the_hunt_read_alike(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    served = frames = 0
    for number in range(40):
        stream = _live_streams.stream(family, number)
        if stream is None:
            continue
        pair = Pair(stream.design, monkeypatch)
        for counts in stream.counts:
            pair.read(counts)
            frames += 1
        served += pair.served
    assert frames > 300
    if family in ("inverting", "row"):
        assert served > 0.04 * frames


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16, 18])
@pytest.mark.parametrize(
    ("circuit", "array", "readout"),
    [
        ("inverting-amplifier", {"rows": 8, "columns": 8, "row_lead": 5.0, "column_lead": 5.0}, {}),
        ("row-amplifier", {"rows": 5, "columns": 9, "row_lead": 8.0, "column_lead": 3.0}, {}),
        ("inverting-amplifier", {"rows": 20, "columns": 16, "row_segment": 0.5, "column_segment": 0.5}, {}),
        ("inverting-amplifier", {"rows": 6, "columns": 4}, {}),
        ("inverting-amplifier", {"rows": 1, "columns": 1}, {}),
        ("inverting-amplifier", {"rows": 7, "columns": 5}, {"open_loop_gain": 2e4, "offset_voltage": 2e-3}),
        ("inverting-amplifier", {"rows": 7, "columns": 5, "row_segment": 1.0, "column_segment": 0.5}, {}),
        (
            "inverting-amplifier",
            {"rows": 3, "columns": 4, "row_lead": 5.0, "column_lead": 9.0},
            {"open_loop_gain": 1e5, "offset_voltage": [1e-3, -2e-3, 0.0, 3e-3]},
        ),
    ],
)
def test_a_skin_that_is_pressed_reads_alike(
    circuit: str, array: dict[str, Any], readout: dict[str, Any], bits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    design = Design.model_validate(
        {
            "array": array,
            "drive": {"voltage": -1.0},
            "readout": {"circuit": circuit, "reference_resistance": 15e3} | readout,
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )
    pair, random = Pair(design, monkeypatch), np.random.default_rng(bits)
    shape = design.array.shape
    ohms = 10e3 * random.uniform(0.9, 1.1, shape)
    for frame in range(FRAMES):
        ohms[frame % shape[0]] *= random.uniform(0.99, 1.01)
        volts = scan(design, ohms).volts
        assert design.adc is not None
        counts = adc_codes(design, volts + random.normal(scale=0.6 * design.adc.step, size=shape)).astype(
            np.uint16 if bits <= 16 else np.uint32
        )
        found, expected = pair.read(counts)
        kpa = random.uniform(-1.0, 30.0, shape)
        kpa.flat[frame % kpa.size] = [np.nan, 0.0, 1e9, -1e9][frame % 4]
        known = frame % 3 > 0
        std_of, reference = (
            systematic.take(reading, rest_known=known)
            for systematic, reading in ((pair.systematic, found), (pair.reference, expected))
        )
        std = std_of(kpa, np.zeros(shape))
        np.testing.assert_allclose(std, reference(kpa, np.zeros(shape)), rtol=5e-10)
        of_estimate = random.uniform(0.0, 1.0, shape)
        np.testing.assert_allclose(std_of(kpa, of_estimate.copy()) ** 2, std**2 + of_estimate, rtol=1e-12)
    assert pair.served > FRAMES / 10


@pytest.mark.parametrize("shape", [(1, 1), (5, 8), (8, 3), (30, 32)])
def test_the_network_of_a_grid_and_its_inverse_are_those_of_array_operations(shape: tuple[int, int]) -> None:
    random = np.random.default_rng(shape[0])
    conductance, lead = 10 ** random.uniform(-7, -1, shape), random.uniform(0.0, 20.0, shape[0])
    assert QuickNetwork.load_loops(shape[1])
    found, expected = (QuickNetwork.of_ideal_lines(conductance, lead, compiled=each) for each in (True, False))
    np.testing.assert_allclose(found.driven, expected.driven, rtol=1e-13)
    np.testing.assert_allclose(found.across, expected.across, rtol=1e-13)
    for to_ground in (0.0, random.uniform(0.0, 0.2, shape[1])):
        # Gauss-Jordan elimination of such a matrix subtracts nowhere but on the diagonal.
        np.testing.assert_allclose(
            _quick._impedance(found, to_ground), _quick._impedance(expected, to_ground), rtol=1e-9
        )


def test_a_column_that_is_connected_to_nothing_has_no_inverse() -> None:
    conductance = np.full((3, 3), 1e-4)
    conductance[:, 1] = 0.0
    network = QuickNetwork.of_ideal_lines(conductance, np.ones(3), compiled=QuickNetwork.load_loops(3))
    with pytest.raises(np.linalg.LinAlgError):
        _quick._impedance(network, 0.0)


@pytest.mark.parametrize("column_lead", [0.0, 9.0])
def test_outputs_of_any_type_and_order_are_read(column_lead: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops do not look at the types of what they are given: another one would be read as if it were theirs."""
    monkeypatch.delenv(compiled.SWITCH, raising=False)
    design = bench.design(4, "inverting-amplifier", "ground", 12).replace(array={"column_lead": column_lead})
    random = np.random.default_rng(3)
    volts = scan(design, random.uniform(9e3, 11e3, (4, 4))).volts.astype(np.float32).astype(np.float64)
    recover = live_recovery(design)
    assert isinstance(recover, AmplifiedLive)
    expected = [recover(volts).resistance for _ in range(3)][-1]
    assert recover._usual(volts, 0.0) is not None
    protected = volts.copy()
    protected.flags.writeable = False
    for same in (volts.astype(np.float32), np.asfortranarray(volts), protected):
        np.testing.assert_array_equal(recover(same).resistance, expected)


def test_usual_frames_hand_loops_arrays_of_exactly_their_types(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba converts others as well, such as write-protected arrays: at 0.3 us a call, of some twenty calls a frame."""
    others: set[tuple[str, str]] = set()
    machine_code, watched = Loop.machine_code, False

    def checked(loop: Loop[..., Any], *, unchecked: bool = False) -> Any:
        code = machine_code(loop)
        types = {
            name: compiled._written(hint) for name, hint in get_type_hints(loop.function, include_extras=True).items()
        }

        def check(*arguments: Any) -> Any:
            for name, argument in zip(types, arguments, strict=False):
                fixed = isinstance(argument, np.ndarray) and not argument.flags.writeable
                if watched and fixed != ("readonly" in types[name]):
                    others.add((loop.__qualname__, name))
            return code(*arguments)  # type: ignore[misc]

        loop.code = loop.unchecked = check
        return check

    monkeypatch.setattr(Loop, "machine_code", checked)
    board, frames = bench.design(8, "inverting-amplifier", "ground", 12), FRAMES
    port = bench.port_of(bench.packets_of(board, bench.pressed((8, 8), frames)[1]), board)
    try:
        with bench.every_frame(port, board, Cell.example(), None) as skin:
            for number in range(frames):
                watched = number > 20  # the noise is known, and all loops have run
                port.work(bench.APART_S)
                _ = skin.read(0.0).pressure_std
    finally:
        for loop in compiled._offered:
            loop.code = loop.unchecked = loop._compiled or loop.function
    assert not others
