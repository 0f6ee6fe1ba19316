"""End to end in board time: pressure, cells, a real board, noise, settling, converter, and a host of nominal parts.

Nothing here depends on the speed of this machine: time is that of the board. The host inverts the circuit with the
nominal parts of the design; what it learns beside these is each cell's resistance at rest, averaged over frames of the
untouched skin before the presses (``operation.readings_per_calibration``). It knows no offset, no lead and no gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..circuits import Adc, Design, apparent_resistance, at_ideal_converter, noise, scan_batch, volts_of_codes
from ..common.arrays import BoolArray, FloatArray
from ..common.geometry import Geometry
from ..driver import CountReader
from ..emulator import Contact, Rectangle
from ..errors import InputError, SolverError
from ._dut import DesignUnderTest, once
from ._judging import box_of, worst_of
from ._outcome import Figure, NotRun
from ._parameters import MAXIMA, Factors
from ._pictures import histories
from ._readings import limited
from ._units import engineering
from .quantities.noise import noise_of
from .quantities.reading_errors import GainError
from .quantities.settling import largest_signal, rate_of, settling_share

SECONDS = 24.0
FASTEST_HZ = 50.0
"""frames are simulated at most this often; faster boards have the settling of their own rate"""
SLOWEST_HZ = 2.0
MOST_WORK = 400_000
"""Cells times frames that are simulated at most: larger arrays are followed at a lower rate."""
TOUCHED = 0.1
"""of full scale: above it a cell counts as touched"""


@dataclass(frozen=True)
class Run:
    """One board's history. Arrays are (frames, rows, columns)."""

    board: str
    """which board of all that can be built"""
    time_s: FloatArray
    applied_kpa: FloatArray
    estimated_kpa: FloatArray
    """NaN before a cell's first valid reading"""
    lost: BoolArray
    """readings beyond the converter's range, or of outputs at a limit"""
    full_scale_kpa: float

    @cached_property
    def error(self) -> FloatArray:
        """Of full scale; a cell that was never read is off by infinity."""
        error = (self.estimated_kpa - self.applied_kpa) / self.full_scale_kpa
        return np.where(np.isfinite(error), error, np.inf)

    @property
    def touched(self) -> BoolArray:
        return np.asarray(self.applied_kpa > TOUCHED * self.full_scale_kpa)

    def rmse(self) -> tuple[float, tuple[int, int]]:
        """Of each cell while it is touched, and of all cells at rest; the worst one and where it is."""
        with np.errstate(invalid="ignore", divide="ignore"):
            square = np.where(self.touched, self.error**2, 0.0).sum(axis=0) / self.touched.sum(axis=0)
            all_the_time = np.mean(self.error**2, axis=0)
        worst = np.fmax(square, all_the_time)
        place = np.unravel_index(int(np.argmax(worst)), worst.shape)
        return float(np.sqrt(worst[place])), (int(place[0]), int(place[1]))

    def peak(self) -> tuple[float, tuple[int, int, int]]:
        """Largest magnitude of the error, and its frame and cell."""
        frame, row, column = np.unravel_index(int(np.argmax(np.abs(self.error))), self.error.shape)
        return float(np.abs(self.error[frame, row, column])), (int(frame), int(row), int(column))


def contacts(shape: tuple[int, int], full: float) -> list[Contact]:
    """Three contacts that overlap in time, on whatever array: a corner, an edge, and a block."""
    rows, columns = shape

    def load(start: float, end: float, level: float) -> list[tuple[float, float]]:
        return [(start, 0.0), (start + 0.1, level * full), (end, level * full), (end + 0.1, 0.0)]

    return [
        Contact(cells=[(0, 0)], load_kpa=load(2.0, 14.0, 1.0)),
        Contact(cells=[(rows - 1, columns // 2)], load_kpa=[*load(5.0, 9.0, 0.6), *load(12.0, 20.0, 0.9)]),
        Contact(
            rectangle=Rectangle(center=(rows / 2, columns - 1.0), size_cells=(2.0, 1.0)),
            load_kpa=[(8.0, 0.0), (16.0, 0.8 * full), (21.0, 0.8 * full), (21.1, 0.0)],
        ),
    ]


def host_design(design: Design) -> Design:
    """What the driver knows: nominal parts, and nothing of offsets, bias currents and converter errors."""
    unknown: dict[str, dict[str, float]] = {}
    for key in MAXIMA:
        section, name = key.split(".")
        if getattr(design, section) is not None and key not in design.spreads:
            unknown.setdefault(section, {})[name] = 0.0
    return design.replace(**unknown)


def require_dynamics(dut: DesignUnderTest) -> None:
    """Raise NotRun, which names what is missing, where the design does not say how noisy and how fast it is."""
    circuit = dut.design.board.circuit
    if circuit.virtual_ground or not circuit.has_amplifiers:  # of a follower neither is modelled
        noise_of(dut)
        largest_signal(dut)


@once
def runs(dut: DesignUnderTest) -> list[Run]:
    """The worst corner of the gain error, and a board drawn at random; worked out once."""
    random = np.random.default_rng(np.random.SeedSequence([dut.seed, 1 << 20]))
    boards = [("a board drawn at random", dut.factors.sample(random, 1)[0])]
    try:
        boards.insert(0, ("the worst corner of the gain error", worst_of(dut, GainError()).factors))
        if not len(dut.factors):
            boards.pop()  # all boards are alike
    except NotRun:
        pass
    return [simulate(dut, name, factors) for name, factors in boards]


def simulate(dut: DesignUnderTest, name: str, factors: FloatArray) -> Run:
    """24 s of one board under three contacts."""
    design, shape = dut.design, dut.design.array.shape
    dut.converter()
    if not dut.knows_pressure:
        raise NotRun("missing: cells.full_scale_kpa")
    declared = rate_of(dut)
    tare = design.operation.readings_per_calibration
    rate_limit = max((MOST_WORK / (shape[0] * shape[1]) - tare) / SECONDS, SLOWEST_HZ)
    rate = min(declared, FASTEST_HZ, rate_limit)
    time_s = np.arange(0.0, SECONDS, 1.0 / rate)
    random = np.random.default_rng(np.random.SeedSequence([dut.seed, 1 << 21]))
    full = dut.full_scale_kpa
    pressing = contacts(shape, full)
    coverage = [contact.coverage(Geometry.rectangle(shape, design.sheet.pitch)) for contact in pressing]
    applied = np.array([sum(c.load(t) * cover for c, cover in zip(pressing, coverage, strict=True)) for t in time_s])
    applied = np.minimum(applied, full)  # contacts meet on small arrays; cells are not meant for more
    scale = 1.0 + dut.cell_spread * random.uniform(-1.0, 1.0, shape)
    forward = dut.cell.forward(shape, rest_resistance_ohm=dut.rest * scale)
    steps = np.diff(time_s, prepend=time_s[0])
    cells = forward.run(steps, applied)
    # The host tares at its own rate before anything presses, however slowly the presses are followed.
    frames = np.concatenate([np.repeat(cells[:1], tare, axis=0), cells])
    volts, lost = _sampled(dut, dut.factors, factors, frames, settling_share(dut, declared), random)
    reader = CountReader(host_design(design))
    read = [reader(counts) for counts in _codes(dut.converter(), volts)]
    untouched = np.stack([measured.resistance for measured in read[:tare]])
    known = np.isfinite(untouched).sum(axis=0)  # of cells that no frame knows, the data sheet's
    rest = np.where(known > 0, np.nansum(untouched, axis=0) / np.maximum(known, 1), dut.rest)
    estimator = dut.cell.estimator(shape, rest_resistance_ohm=rest)
    estimated, _ = estimator.run_measured(steps, np.stack([measured.block for measured in read[tare:]]))
    return Run(name, time_s, applied, estimated, lost[tare:], full)


def _sampled(
    dut: DesignUnderTest,
    parts: Factors,
    factors: FloatArray,
    cells: FloatArray,
    share: float,
    random: np.random.Generator,
) -> tuple[FloatArray, BoolArray]:
    """V at an ideal converter that stand for those of a real board and its converter, and which readings are lost."""
    population, box = parts.population(factors[None]), box_of(dut)
    board = population.boards.design(dut.hot, 0)
    found = scan_batch(board, cells)
    previous = np.roll(found.volts, 1, axis=2 if dut.design.board.transposed else 1)
    volts = found.volts + share * (previous - found.volts)
    try:
        states = [noise(board, uniform).before_adc for uniform in dut.uniform.values()]
        volts = volts + random.standard_normal(volts.shape) * np.maximum(*states)
    except (InputError, SolverError):  # no noise is given, which its own requirement says
        pass
    volts = at_ideal_converter(board, volts, population.converter[0])
    at_limit = limited(box, volts, found.saturated)
    return volts, at_limit > 0.0 if box.scale.open_is_rest else at_limit != 0.0


def _codes(adc: Adc, volts: FloatArray) -> NDArray[np.int64]:
    codes: NDArray[np.int64] = np.clip(np.floor((volts - adc.range[0]) / adc.step), 0, 2.0**adc.bits - 1).astype(int)
    return codes


def one_cell_read(dut: DesignUnderTest, ohms: FloatArray) -> tuple[FloatArray, float]:
    """What the nominal board reads of one cell with this history (samples,), among cells at rest.

    Returns:
        Apparent ohm (samples,), and the share of readings that are lost to a limit. The frame rate is that of the
        design, or :data:`FASTEST_HZ` where the design states none.
    """
    shape = dut.design.array.shape
    place = (shape[0] // 2, shape[1] // 2)
    cells = np.full((len(ohms), *shape), dut.rest)
    cells[:, *place] = ohms
    share = settling_share(dut, dut.design.operation.frame_rate or FASTEST_HZ)
    random = np.random.default_rng(np.random.SeedSequence([dut.seed, 1 << 22]))
    nominal = Factors.nominal(dut.design)
    volts, lost = _sampled(dut, nominal, np.zeros(0), cells, share, random)
    if dut.design.adc is not None:
        volts = volts_of_codes(dut.design, _codes(dut.design.adc, volts))
    return apparent_resistance(dut.design, volts)[:, *place], float(lost[:, *place].mean())


def what_is_in(dut: DesignUnderTest) -> str:
    rate = rate_of(dut)
    share = settling_share(dut, rate)
    settled = (
        f"{100 * share:.2g} % of the preceding row is left in each reading" if share else "readings settle in full"
    )
    return (
        f"Declared rate {engineering(rate, 'Hz')}: {settled}. Noise, converter and parts are those of the design; the "
        "host knows nominal parts and takes each cell's resistance at rest from "
        f"{dut.design.operation.readings_per_calibration} frames before the presses. Estimator: "
        f"{dut.cell.default_estimator}."
    )


def traces(run: Run) -> list[Figure]:
    """The most pressed cells."""
    busiest = np.argsort(-run.applied_kpa.sum(axis=0), axis=None)[:3].tolist()
    places = [divmod(cell, run.applied_kpa.shape[2]) for cell in busiest]
    caption = f"The most pressed cells, read by {run.board}."
    return histories(caption, run.time_s, run.applied_kpa, run.estimated_kpa, places, "host's estimate")
