"""Contacts of a whole skin: multi-object tracking of fingers, detection of short taps, and false alarms.

Scenes (:data:`SCENES`) are played on emulated boards, which are read through a :class:`ohmskin.driver.Skin` that is
tared at the beginning. A scene is played several times in one stream, along another direction and with other forces
each time:

* two fingers cross, or pass each other at a distance of some cells; one finger rolls, or swipes by one or two cells in
  a frame; one goes across a row that is dead; a light one stays where it is for seconds;
* fingertips and a stylus tap for 30 to 150 ms; a stylus taps single cells, as fingertips do where the pitch is larger;
* nothing touches the skin, but the rest resistances of all its cells drift, or that of one; or its electrical contacts
  fail: of one cell, of a line's connection, or several readings in a row in one frame, as a motor disturbs them.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product

import numpy as np

from ..cell import Cell
from ..circuits import Design
from ..common.arrays import FloatArray
from ..driver import Contact, Skin
from ..errors import InputError
from ._driver import OnBoard, described, design, quantised
from ._paced_port import PacedPort, frame_packets
from .harness import column

BoardCase = tuple[str, str, int, float]
BOARDS: tuple[BoardCase, ...] = (
    ("inverting-amplifier", "ground", 12, 1.0),
    ("inverting-amplifier", "ground", 12, 10.0),
    ("inverting-amplifier", "ground", 8, 1.0),
    ("voltage-divider", "ground", 12, 1.0),
    ("voltage-divider", "ground", 8, 1.0),
    ("voltage-divider", "ground", 8, 4.0),
    ("voltage-divider", "float", 12, 1.0),
    ("voltage-divider", "float", 8, 4.0),
)
"""circuit, idle rows, ADC bits, mV of noise"""
RATE_HZ, FAST_HZ = 100.0, 1000.0
REST_S = 0.6
"""before each play"""
MOVE_S, HOLD_S, TAP_S = 1.0, 5.0, 0.3
TAPS_S = (0.03, 0.05, 0.08, 0.15)
PLAYS, PLAYS_OF_TAPS = 6, 12
WAY_CELLS = 3.0
"""from the middle of the skin to either end of a finger's way"""
WIDTHS_CELLS = (0.35, 0.6, 0.9)
"""standard deviations of the bells that press: a stylus, a small and a large fingertip"""
WIDTH_CELLS, STYLUS_CELLS = 0.8, 0.1
CELL_VARIANCE = 1.0 / 12.0
"""of the width of a cell: the mean of a bell over a cell is nearly a bell that is wider by as much"""
SWIPE_CELLS = 7.0
"""way of a finger that swipes, from touching the skin to leaving it"""
PEAKS, TAPPED, LIGHT = (0.3, 0.7), (0.2, 0.8), (0.12, 0.12)
"""of full scale"""
DRIFT, DRIFT_S = 0.03, 24.0
"""relative change of rest resistances, and the time in which it comes about"""
FAILS_S, EVERY_S = 5.0, 0.4
"""in which electrical contacts fail, and from one to the next"""
SPREAD = 0.03
"""standard deviation of the logarithm of rest resistances where contacts fail: equal cells would all stand at the same
place within an ADC step, so that their roundings add up in a column of a divider"""
MOVES_ON, TAPS_ON = 8, 4
"""least side of arrays: fingers need their way"""
EDGE_S, TAP_EDGE_S = 0.05, 0.01
"""in which a finger comes down and is lifted; not judged"""
LATE_S = 0.03
"""after the edge a finger may still be looked for, and its contact may still be there"""
NEAR_CELLS = 1.5
"""distance of a contact from its finger"""
TARE_FRAMES = 20

Seen = Sequence[tuple[float, tuple[Contact, ...]]]
"""time in s and contacts of each frame"""
Path = Callable[[FloatArray], FloatArray]
"""shares (n,) of the time of a play -> positions (fingers, n, 2) in cells from the middle of the skin"""
Way = Callable[[np.random.Generator, int], Path]
"""random generator and side of the array -> the path of one play"""

HEAD = (
    "contacts of fingers: % of the fingers seen, and of their frames; delay of the first contact; % of the plays in "
    "which each finger keeps its id; further ids; seconds with contacts but no finger; force over the finger's, "
    "distance from it"
)


@dataclass(frozen=True)
class Fingers(OnBoard):
    """One scene on one board."""

    noise_mv: float = field(metadata=column("noise, mV", "{:g}"))
    rate_hz: float = field(metadata=column("frames/s", "{:.0f}"))
    scene: str = field(metadata=column("scene", "{}", width=22))
    seen_percent: float = field(metadata=column("seen", "{:.0f}"))
    """of the fingers, those with a contact near them while they press, or soon after"""
    found_percent: float = field(metadata=column("frames", "{:.0f}"))
    """of the fingers in the frames in which they press, those with a contact near them, or in a joined one"""
    delay_ms: float = field(metadata=column("delay, ms", "{:.0f}"))
    """median time from the beginning of a press to its first contact"""
    ids_kept_percent: float = field(metadata=column("ids kept", "{:.0f}"))
    """of the plays, those in which each finger has one id, from its first contact to its last one"""
    false: int = field(metadata=column("false", "{}"))
    """ids beyond one for each finger that is seen"""
    false_s: float = field(metadata=column("false, s", "{:.2f}"))
    """time in which there was any contact though no finger was on the skin, from :data:`LATE_S` after the last one"""
    force_share: float = field(metadata=column("force", "{:.2f}"))
    """median force of a contact that is one finger's alone, over that of its finger"""
    off_cells: float = field(metadata=column("off, cells", "{:.2f}"))
    """median distance of such a contact from its finger's centre of pressure"""


# -- scenes ------------------------------------------------------------------------------------------------------------


def _direction(angle: float) -> FloatArray:
    return np.array([math.cos(angle), math.sin(angle)])


def _cross(rng: np.random.Generator, side: int) -> Path:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    ends = WAY_CELLS * np.array([_direction(angle), _direction(angle + rng.uniform(1.3, 1.85))])
    return lambda share: (2.0 * share - 1.0)[:, None] * ends[:, None]


def _pass(gap_cells: float) -> Way:
    def way(rng: np.random.Generator, side: int) -> Path:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        end, aside = WAY_CELLS * _direction(angle), gap_cells / 2.0 * _direction(angle + np.pi / 2.0)
        return lambda share: np.array([1.0, -1.0])[:, None, None] * ((2.0 * share - 1.0)[:, None] * end + aside)

    return way


def _roll(rng: np.random.Generator, side: int) -> Path:
    start = rng.uniform(0.0, 2.0 * np.pi)

    def path(share: FloatArray) -> FloatArray:
        turn = start + np.pi * share
        return WAY_CELLS * 0.7 * np.stack([np.cos(turn), np.sin(2.0 * turn)], axis=1)[None]

    return path


def _down(rng: np.random.Generator, side: int) -> Path:
    aside = rng.uniform(-2.0, 2.0)
    return lambda share: np.stack([(2.0 * share - 1.0) * WAY_CELLS, np.full(share.size, aside)], axis=1)[None]


def _swipe(rng: np.random.Generator, side: int) -> Path:
    end, aside = SWIPE_CELLS / 2.0 * _direction(rng.uniform(0.0, 2.0 * np.pi)), rng.uniform(-0.5, 0.5, 2)
    return lambda share: ((2.0 * share - 1.0)[:, None] * end + aside)[None]


def _stay(rng: np.random.Generator, side: int) -> Path:
    reach = min(WAY_CELLS, (side - 1) / 2.0)
    place = rng.uniform(-reach, reach, 2)
    return lambda share: np.asarray(np.broadcast_to(place, (1, share.size, 2)))


@dataclass(frozen=True)
class Scene:
    """What happens on the skin."""

    name: str
    way: Way | None = None
    """None: nothing touches the skin"""
    seconds: float = MOVE_S
    plays: int = PLAYS
    widths_cells: tuple[float, ...] = (WIDTH_CELLS,)
    """of the bells, in turn"""
    peaks: tuple[float, float] = PEAKS
    edge_s: float = EDGE_S
    on_cells: bool = False
    """presses are in the middle of cells"""
    dead_row: bool = False
    substeps: int = 1
    """in which a frame's load is simulated"""
    drifting: str = ""
    """"all" or "one" of the cells"""
    failing: str = ""
    """one of :data:`FAILURES`"""
    rates_hz: tuple[float, ...] = (RATE_HZ,)
    least_side: int = MOVES_ON


FAILURES = ("cell", "line", "impulse")
_short = partial(Scene, rates_hz=(RATE_HZ, FAST_HZ), least_side=TAPS_ON)
SCENES = (
    Scene("two cross", _cross),
    *(Scene(f"two pass, {gap:g} cells", _pass(gap)) for gap in (1.0, 1.5, 2.0)),
    Scene("one rolls", _roll),
    *(
        Scene(f"swipe, {speed:g} cells a frame", _swipe, seconds=SWIPE_CELLS / speed / RATE_HZ, substeps=8)
        for speed in (1.0, 2.0)
    ),
    Scene("across a dead row", _down, dead_row=True),
    Scene("light, held 5 s", _stay, seconds=HOLD_S, plays=2, peaks=LIGHT),
    Scene("lone cells, 300 ms", _stay, TAP_S, PLAYS_OF_TAPS, widths_cells=(STYLUS_CELLS,), on_cells=True),
    *(
        _short(f"taps of {1e3 * tap_s:.0f} ms", _stay, tap_s, PLAYS, WIDTHS_CELLS, TAPPED, TAP_EDGE_S, substeps=4)
        for tap_s in TAPS_S
    ),
    Scene("drift of all cells", seconds=DRIFT_S, plays=1, drifting="all"),
    Scene("drift of one cell", seconds=DRIFT_S, plays=1, drifting="one"),
    *(_short(f"{kind} fails", seconds=FAILS_S, plays=1, failing=kind) for kind in FAILURES),
)


@dataclass(frozen=True)
class Press:
    """A bell of pressure that comes, and moves, and goes."""

    start_s: float
    end_s: float
    edge_s: float
    """in which it comes, and goes"""
    places: Callable[[FloatArray], FloatArray]
    """times (n,) -> row and column (n, 2) of its middle"""
    variance: float
    """of the bell, in cells^2"""
    peak_kpa: float

    @classmethod
    def tap(
        cls, start_s: float, duration_s: float, row: float, column: float, width_cells: float, peak_kpa: float
    ) -> Press:
        """A press at one place."""
        edge_s = min(TAP_EDGE_S, duration_s / 3.0)
        there = np.array([[row, column]])
        variance = width_cells**2 + CELL_VARIANCE
        return cls(start_s, start_s + duration_s, edge_s, lambda _: there, variance, peak_kpa)

    def kpa(self, time_s: FloatArray, shape: tuple[int, int]) -> FloatArray:
        """(n, rows, columns) pressure at times (n,)."""
        corners = [self.start_s, self.start_s + self.edge_s, self.end_s - self.edge_s, self.end_s]
        load = self.peak_kpa * np.interp(time_s, corners, [0.0, 1.0, 1.0, 0.0])
        row, column = np.indices(shape)
        place = self.places(time_s)
        away = (row - place[:, 0, None, None]) ** 2 + (column - place[:, 1, None, None]) ** 2
        found = load[:, None, None] * np.exp(-away / (2.0 * self.variance))
        return np.where(found < 1e-3, 0.0, found)


def resistances(
    presses: Iterable[Press], shape: tuple[int, int], rate_hz: float, seconds: float, substeps: int = 4
) -> FloatArray:
    """(frames, rows, columns) ohm of example cells that are pressed."""
    fine = np.arange(1.0, round(seconds * rate_hz) * substeps + 1) / (substeps * rate_hz)
    kpa = np.zeros((len(fine), *shape))
    for press in presses:
        during = slice(*np.searchsorted(fine, [press.start_s, press.end_s]))
        kpa[during] += press.kpa(fine[during], shape)
    dt_s = np.full(len(kpa), 1.0 / (substeps * rate_hz))
    ohm: FloatArray = Cell.example().forward(shape).run(dt_s, kpa)[substeps - 1 :: substeps]
    return ohm


def let_fail(ohm: FloatArray, kind: str, rate_hz: float, rng: np.random.Generator) -> int:
    """Let electrical contacts fail, one every :data:`EVERY_S`; changes ``ohm`` (frames, rows, columns).

    Returns:
        How many failed.

    """
    rows, columns = ohm.shape[1:]
    starts = np.arange(REST_S, len(ohm) / rate_hz - EVERY_S, EVERY_S).tolist()
    for start in starts:
        first = round(start * rate_hz)
        last = max(round((start + rng.uniform(0.002, 0.09)) * rate_hz), first + 1)
        i, j = int(rng.integers(rows)), int(rng.integers(columns))
        factor = rng.uniform(1.1, 3.0)
        if kind == "cell":
            ohm[first:last, i, j] *= np.inf if rng.random() < 0.2 else factor
        elif kind == "impulse":
            ohm[first, i, j : j + 3] *= factor
        else:
            line = (i, slice(None)) if rng.random() < 0.5 else (slice(None), j)
            ohm[(slice(first, last), *line)] *= factor
    return len(starts)


# -- measurements ------------------------------------------------------------------------------------------------------


def contacts_of(
    board: Design, ohm: FloatArray, noise_mv: float, rate_hz: float, rng: np.random.Generator
) -> Iterator[tuple[float, tuple[Contact, ...]]]:
    """Time in s and contacts of each frame (frames, rows, columns) of a skin that is tared at the beginning."""
    packets = frame_packets(quantised(board, ohm, 1e-3 * noise_mv, rng), rate_hz)
    port = PacedPort(packets, 1e-3, board)
    port.work(10.0 + 1e-3 * len(packets))  # all frames have come
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # few valid cells
        with Skin(port, design=board, cell=Cell.example(), delivery="lossless", timeout=60.0) as skin:
            with contextlib.suppress(InputError):  # no cell is valid
                skin.tare(TARE_FRAMES)
            taken = TARE_FRAMES
            while taken < len(packets):
                frames = skin.read_many()
                for n, frame in enumerate(frames, taken):
                    yield n / rate_hz, frame.contacts
                taken += len(frames)


def fingers(sizes: Iterable[int]) -> Iterator[Fingers]:
    """Play each scene on each board, at all frame rates of the scene; small arrays have few scenes."""
    for size, board, scene in product(sizes, BOARDS, SCENES):
        for rate_hz in scene.rates_hz if size >= scene.least_side else ():
            yield played(size, board, scene, np.random.default_rng(0), rate_hz)


def played(size: int, board: BoardCase, scene: Scene, rng: np.random.Generator, rate_hz: float = RATE_HZ) -> Fingers:
    """Play one scene on one board."""
    circuit, idle_rows, bits, noise_mv = board
    readout, shape = design(size, circuit, idle_rows, bits), (size, size)
    seconds = REST_S + scene.plays * (scene.seconds + REST_S)
    plays = [_play(k, scene, size, rng) for k in range(scene.plays)] if scene.way else []
    ohm = resistances((press for play in plays for press in play), shape, rate_hz, seconds, scene.substeps)
    if scene.dead_row:
        ohm[:, size // 2] = np.inf
    if scene.drifting:
        time_s = np.arange(1.0, len(ohm) + 1) / rate_hz
        drift = 1.0 + DRIFT * np.clip((time_s - REST_S) / scene.seconds, 0.0, 1.0)
        where = np.s_[:, :, :] if scene.drifting == "all" else np.s_[:, size // 2, size // 3, None]
        ohm[where] *= drift.reshape(-1, *[1] * (ohm[where].ndim - 1))
    if scene.failing:
        ohm *= np.exp(SPREAD * np.random.default_rng(size).standard_normal(shape))
        let_fail(ohm, scene.failing, rate_hz, rng)
    seen = list(contacts_of(readout, ohm, noise_mv, rate_hz, rng))
    judged = _Judged(1e3 * (readout.sheet.pitch or 1.0), 1.0 / rate_hz, shape)
    for play in plays:
        judged.add(play, seen)
    pressing = [press for play in plays for press in play]
    untouched = [now for now, contacts in seen if contacts and not any(_touches(one, now) for one in pressing)]
    ids = {contact.id for _, contacts in seen for contact in contacts}
    return Fingers(
        *described(readout),
        noise_mv=noise_mv,
        rate_hz=rate_hz,
        scene=scene.name,
        seen_percent=_percent([math.isfinite(delay_s) for delay_s in judged.delays_s]),
        found_percent=_percent(judged.found),
        delay_ms=1e3 * _median([delay_s for delay_s in judged.delays_s if math.isfinite(delay_s)]),
        ids_kept_percent=_percent(judged.kept),
        false=max(len(ids) - sum(map(math.isfinite, judged.delays_s)), 0),
        false_s=len(untouched) / rate_hz,
        force_share=_median(judged.force_shares),
        off_cells=_median(judged.off_cells),
    )


def _percent(values: Sequence[bool]) -> float:
    return 100.0 * float(np.mean(values)) if values else np.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else np.nan


def _play(number: int, scene: Scene, size: int, rng: np.random.Generator) -> list[Press]:
    """The fingers of one play."""
    assert scene.way is not None
    start_s, path = REST_S + number * (scene.seconds + REST_S), scene.way(rng, size)

    def place(time_s: FloatArray, finger: int) -> FloatArray:
        share = np.clip((time_s - start_s) / scene.seconds, 0.0, 1.0)
        at = (size - 1) / 2.0 + path(share)[finger]
        return np.asarray(np.round(at) if scene.on_cells else at)

    peaks = Cell.example().full_scale_kpa * rng.uniform(*scene.peaks, len(path(np.zeros(1))))
    width = scene.widths_cells[number % len(scene.widths_cells)]
    variance = width**2 + (0.0 if scene.on_cells else CELL_VARIANCE)
    edge_s, end_s = min(scene.edge_s, scene.seconds / 6.0), start_s + scene.seconds
    return [
        Press(start_s, end_s, edge_s, partial(place, finger=k), variance, peak) for k, peak in enumerate(peaks.tolist())
    ]


def _touches(press: Press, time_s: float) -> bool:
    return press.start_s <= time_s <= press.end_s + LATE_S


@dataclass
class _Judged:
    """Contacts compared with fingers."""

    pitch_mm: float
    frame_s: float
    shape: tuple[int, int]
    found: list[bool] = field(default_factory=list)
    delays_s: list[float] = field(default_factory=list)
    """of each finger until its first contact; infinite if there was none"""
    kept: list[bool] = field(default_factory=list)
    force_shares: list[float] = field(default_factory=list)
    off_cells: list[float] = field(default_factory=list)

    def add(self, play: Sequence[Press], seen: Seen) -> None:
        """Take the fingers of a play, which press at the same time."""
        start_s, end_s, edge_s = play[0].start_s, play[0].end_s, play[0].edge_s
        during = [one for one in seen if start_s < one[0] <= end_s + LATE_S]
        time_s = np.array([now_s for now_s, _ in during])
        loads = np.array([press.kpa(time_s + self.frame_s, self.shape) for press in play])
        first_s, centres = [math.inf] * len(play), [(math.nan, math.nan)] * len(play)
        names: list[set[int]] = [set() for _ in play]
        rows, columns = np.indices(self.shape)
        settled_s = min(start_s + edge_s + LATE_S, 0.5 * (start_s + end_s))
        judged = len(self.found)
        for (now_s, contacts), load in zip(during, np.moveaxis(loads, 1, 0), strict=True):
            places = [(one.y_mm / self.pitch_mm, one.x_mm / self.pitch_mm) for one in contacts]
            held = settled_s < now_s < end_s - edge_s / 2
            for finger, kpa in enumerate(load):
                if total := float(kpa.sum()):
                    centres[finger] = float((rows * kpa).sum()) / total, float((columns * kpa).sum()) / total
                far = [math.dist(centres[finger], place) for place in places]
                near = [away < NEAR_CELLS + 2.0 * bool(one.joined) for one, away in zip(contacts, far, strict=True)]
                if held and total:
                    self.found.append(any(near))
                if not any(near):
                    continue
                first_s[finger] = min(first_s[finger], now_s)
                contact = contacts[int(np.argmin(far))]
                if held and total and not contact.joined and min(far) < NEAR_CELLS:
                    names[finger].add(contact.id)
                    if len(contacts) == len(play):
                        self.off_cells.append(min(far))
                        self.force_shares.append(contact.force_n / (1e-3 * total * self.pitch_mm**2))
        if len(self.found) > judged:  # else no frame lies between the edges
            self.kept.append(all(len(one) == 1 for one in names) and len(set().union(*names)) == len(names))
        self.delays_s += [first - start_s for first in first_s]
