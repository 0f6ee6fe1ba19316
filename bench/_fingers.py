"""Tracking of fingers (multi-object tracking), false contacts by drift, and a dead row: contacts of a whole skin.

Fingers move over emulated boards, which are read through a whole :class:`ohmskin.driver.Skin`. Each scene is played
several times in one stream, along another direction and with other forces each time:

* two fingers cross, or pass each other at a distance of some cells; one finger rolls over the skin;
* a finger swipes over the skin, by one or two cells in a frame;
* a finger goes across a row that is dead; a light finger stays where it is for seconds;
* nothing touches the skin, but the rest resistances of all its cells drift, or that of one;
* a stylus taps single cells, as fingertips do where the pitch is larger than they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from ..cell import Cell
from ..common.arrays import FloatArray
from ..driver import Contact
from ._driver import OnBoard, described, design
from ._taps import CELL_VARIANCE, bell, contacts_of, read, times_of
from .harness import column

BOARDS: tuple[tuple[str, str, int, float], ...] = (
    ("inverting-amplifier", "ground", 12, 1.0),
    ("inverting-amplifier", "ground", 12, 10.0),
    ("voltage-divider", "ground", 12, 1.0),
    ("voltage-divider", "ground", 8, 1.0),
)
"""circuit, idle rows, ADC bits, mV of noise"""
RATE_HZ = 100.0
REST_S = 0.6
"""before each play"""
MOVE_S, HOLD_S, TAP_S = 1.0, 5.0, 0.3
PLAYS, PLAYS_OF_TAPS = 6, 12
WAY_CELLS = 3.0
"""from the middle of the skin to either end of a finger's way"""
WIDTH_CELLS = 0.8
"""standard deviation of a fingertip's bell"""
STYLUS_CELLS = 0.1
SWIPE_CELLS = 7.0
"""way of a finger that swipes, from touching the skin to leaving it"""
SUBSTEPS = 8
"""in which a frame's load is simulated of a finger that moves by cells within a frame"""
PEAKS, LIGHT = (0.3, 0.7), 0.12
"""of full scale"""
DRIFT, DRIFT_S = 0.03, 24.0
"""relative change of rest resistances, and the time in which it comes about"""
LEAST_SIZE = 8
"""of arrays: fingers need their way"""
EDGE_S = 0.05
"""in which a finger comes down and is lifted; not judged"""
LATE_S = 0.03
"""after the edge a finger may still be looked for"""
NEAR_CELLS = 1.5

Way = Callable[[FloatArray, np.random.Generator], FloatArray]
"""Positions (fingers, n, 2) in cells from the middle of the skin, at shares (n,) of the time of a play."""


HEAD = (
    "contacts of moving fingers: % found while they press, delay of the first contact, % of the plays in which each "
    "finger keeps its id, ids beyond one for each finger, seconds with contacts but no finger, force over the "
    "finger's, distance from it"
)


@dataclass(frozen=True)
class Fingers(OnBoard):
    """One scene on one board."""

    noise_mv: float = field(metadata=column("noise, mV", "{:g}"))
    scene: str = field(metadata=column("scene", "{}", width=22))
    found_percent: float = field(metadata=column("found", "{:.0f}"))
    """of the fingers in the frames in which they press, those with a contact near them, or in a joined one"""
    delay_ms: float = field(metadata=column("delay, ms", "{:.0f}"))
    """median time from the beginning of a press to its first contact"""
    ids_kept_percent: float = field(metadata=column("ids kept", "{:.0f}"))
    """of the plays, those in which each finger has one id, from its first contact to its last one"""
    false: int = field(metadata=column("false", "{}"))
    """ids beyond one for each finger of each play"""
    false_s: float = field(metadata=column("false, s", "{:.2f}"))
    """time in which there was any contact though no finger was on the skin, from :data:`LATE_S` after the last one"""
    force_share: float = field(metadata=column("force", "{:.2f}"))
    """median force of a contact that is one finger's alone, over that of its finger"""
    off_cells: float = field(metadata=column("off, cells", "{:.2f}"))
    """median distance of such a contact from its finger's centre of pressure"""


def _direction(angle: float) -> FloatArray:
    return np.array([math.cos(angle), math.sin(angle)])


def _cross(share: FloatArray, rng: np.random.Generator) -> FloatArray:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    along = (2.0 * share - 1.0)[:, None] * WAY_CELLS
    return np.array([along * _direction(angle), along * _direction(angle + rng.uniform(1.3, 1.85))])


def _pass(gap_cells: float) -> Way:
    def ways(share: FloatArray, rng: np.random.Generator) -> FloatArray:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        along = (2.0 * share - 1.0)[:, None] * WAY_CELLS * _direction(angle)
        aside = gap_cells / 2.0 * _direction(angle + np.pi / 2.0)
        return np.array([along + aside, -along - aside])

    return ways


def _roll(share: FloatArray, rng: np.random.Generator) -> FloatArray:
    start = rng.uniform(0.0, 2.0 * np.pi)
    turn = start + np.pi * share
    return WAY_CELLS * 0.7 * np.stack([np.cos(turn), np.sin(2.0 * turn)], axis=1)[None]


def _down(share: FloatArray, rng: np.random.Generator) -> FloatArray:
    aside = rng.uniform(-2.0, 2.0)
    return np.stack([(2.0 * share - 1.0) * WAY_CELLS, np.full(share.size, aside)], axis=1)[None]


def _swipe(share: FloatArray, rng: np.random.Generator) -> FloatArray:
    along = (2.0 * share - 1.0)[:, None] * SWIPE_CELLS / 2.0
    return (along * _direction(rng.uniform(0.0, 2.0 * np.pi)) + rng.uniform(-0.5, 0.5, 2))[None]


def _stay(share: FloatArray, rng: np.random.Generator) -> FloatArray:
    place = rng.uniform(-WAY_CELLS, WAY_CELLS, 2)
    return np.asarray(np.broadcast_to(place, (1, share.size, 2)))


@dataclass(frozen=True)
class Scene:
    """What happens on the skin."""

    name: str
    ways: Way | None
    """None: nothing touches the skin"""
    seconds: float = MOVE_S
    plays: int = PLAYS
    width_cells: float = WIDTH_CELLS
    peaks: tuple[float, float] = PEAKS
    on_cells: bool = False
    """presses are in the middle of cells"""
    dead_row: bool = False
    substeps: int = 1
    """in which a frame's load is simulated"""
    drifting: str = ""
    """"all" or "one" of the cells"""


SCENES = (
    Scene("two cross", _cross),
    *(Scene(f"two pass, {gap:g} cells", _pass(gap)) for gap in (1.0, 1.5, 2.0)),
    Scene("one rolls", _roll),
    *(
        Scene(f"swipe, {speed:g} cells a frame", _swipe, seconds=SWIPE_CELLS / speed / RATE_HZ, substeps=SUBSTEPS)
        for speed in (1.0, 2.0)
    ),
    Scene("across a dead row", _down, dead_row=True),
    Scene("light, held 5 s", _stay, seconds=HOLD_S, plays=2, peaks=(LIGHT, LIGHT)),
    Scene("lone cells, 300 ms", _stay, seconds=TAP_S, plays=PLAYS_OF_TAPS, width_cells=STYLUS_CELLS, on_cells=True),
    Scene("drift of all cells", None, seconds=DRIFT_S, plays=1, drifting="all"),
    Scene("drift of one cell", None, seconds=DRIFT_S, plays=1, drifting="one"),
)


@dataclass(frozen=True)
class Play:
    """Fingers on the skin for a while."""

    start_s: float
    end_s: float
    edge_s: float
    """in which the fingers come down, and are lifted"""
    kpa: FloatArray
    """(fingers, steps, rows, columns)"""


def fingers(sizes: Iterable[int], *, scenes: Iterable[Scene] = SCENES, seed: int = 0) -> Iterator[Fingers]:
    """Play each scene on each of the :data:`BOARDS`, at sizes of :data:`LEAST_SIZE` and more."""
    for size, board, scene in product([size for size in sizes if size >= LEAST_SIZE], BOARDS, tuple(scenes)):
        yield played(size, board, scene, np.random.default_rng(seed))


def played(size: int, board: tuple[str, str, int, float], scene: Scene, rng: np.random.Generator) -> Fingers:
    """Play one scene on one board."""
    circuit, idle_rows, bits, noise_mv = board
    readout = design(size, circuit, idle_rows, bits)
    seconds, each = REST_S + scene.plays * (scene.seconds + REST_S), scene.substeps
    fine_s = times_of(seconds, RATE_HZ, each)
    plays = [_play(k, scene, size, fine_s, rng) for k in range(scene.plays)] if scene.ways else []
    ohm = read(sum((play.kpa.sum(axis=0) for play in plays), np.zeros((len(fine_s), size, size))), RATE_HZ, each)
    if scene.dead_row:
        ohm[:, size // 2] = np.inf
    if scene.drifting:
        drift = 1.0 + DRIFT * np.clip((fine_s[each - 1 :: each] - REST_S) / scene.seconds, 0.0, 1.0)
        where = np.s_[:, :, :] if scene.drifting == "all" else np.s_[:, size // 2, size // 3, None]
        ohm[where] *= drift.reshape(-1, *[1] * (ohm[where].ndim - 1))
    seen = list(contacts_of(readout, ohm, noise_mv, RATE_HZ, rng))
    judged = _Judged(1e3 * (readout.sheet.pitch or 1.0))
    for play in plays:
        judged.add(play, play.kpa[:, each - 1 :: each], seen)
    ids = {contact.id for _, contacts in seen for contact in contacts}
    untouched = [now_s for now_s, contacts in seen if contacts and not any(_touches(play, now_s) for play in plays)]
    return Fingers(
        *described(readout),
        noise_mv=noise_mv,
        scene=scene.name,
        found_percent=100.0 * float(np.mean(judged.found)) if judged.found else np.nan,
        delay_ms=1e3 * float(np.median(judged.delays_s)) if judged.delays_s else np.nan,
        ids_kept_percent=100.0 * float(np.mean(judged.kept)) if judged.kept else np.nan,
        false=max(len(ids) - sum(len(play.kpa) for play in plays), 0),
        false_s=len(untouched) / RATE_HZ,
        force_share=float(np.median(judged.force_shares)) if judged.force_shares else np.nan,
        off_cells=float(np.median(judged.off_cells)) if judged.off_cells else np.nan,
    )


def _play(number: int, scene: Scene, size: int, time_s: FloatArray, rng: np.random.Generator) -> Play:
    assert scene.ways is not None
    start_s = REST_S + number * (scene.seconds + REST_S)
    end_s = start_s + scene.seconds
    places = (size - 1) / 2.0 + scene.ways(np.clip((time_s - start_s) / scene.seconds, 0.0, 1.0), rng)
    places = np.round(places) if scene.on_cells else places
    edge_s = min(EDGE_S, scene.seconds / 6.0)
    down = np.interp(time_s, [start_s, start_s + edge_s, end_s - edge_s, end_s], [0.0, 1.0, 1.0, 0.0])
    peaks = Cell.example().full_scale_kpa * rng.uniform(*scene.peaks, len(places))
    variance = scene.width_cells**2 + (0.0 if scene.on_cells else CELL_VARIANCE)
    kpa = (peaks[:, None] * down)[:, :, None, None] * np.array([bell(one, variance, (size, size)) for one in places])
    return Play(start_s, end_s, edge_s, np.where(kpa < 1e-3, 0.0, kpa))


def _touches(play: Play, time_s: float) -> bool:
    return play.start_s <= time_s <= play.end_s + LATE_S


@dataclass
class _Judged:
    """Contacts compared with fingers."""

    pitch_mm: float
    found: list[bool] = field(default_factory=list)
    delays_s: list[float] = field(default_factory=list)
    kept: list[bool] = field(default_factory=list)
    force_shares: list[float] = field(default_factory=list)
    off_cells: list[float] = field(default_factory=list)

    def add(self, play: Play, load: FloatArray, seen: list[tuple[float, tuple[Contact, ...]]]) -> None:
        """Take a play with loads (fingers, frames, rows, columns) in kPa."""
        first_s = np.full(len(load), np.inf)
        names: list[set[int]] = [set() for _ in load]
        rows, columns = np.indices(load.shape[2:])
        settled_s = min(play.start_s + play.edge_s + LATE_S, 0.5 * (play.start_s + play.end_s))
        for now_s, contacts in seen:
            if not play.start_s < now_s < play.end_s - play.edge_s / 2:
                continue
            places = [(one.y_mm / self.pitch_mm, one.x_mm / self.pitch_mm) for one in contacts]
            for finger, kpa in enumerate(load[:, min(round(now_s * RATE_HZ), load.shape[1] - 1)]):
                if not (total := float(kpa.sum())):
                    continue
                centre = float((rows * kpa).sum()) / total, float((columns * kpa).sum()) / total
                far = [math.dist(centre, place) for place in places]
                near = [away < NEAR_CELLS + 2.0 * bool(one.joined) for one, away in zip(contacts, far, strict=True)]
                held = now_s > settled_s
                if held:
                    self.found.append(any(near))
                if not any(near):
                    continue
                first_s[finger] = min(first_s[finger], now_s)
                contact = contacts[int(np.argmin(far))]
                if held and not contact.joined and min(far) < NEAR_CELLS:
                    names[finger].add(contact.id)
                    if len(contacts) == len(load):
                        self.off_cells.append(min(far))
                        self.force_shares.append(contact.force_n / (1e-3 * total * self.pitch_mm**2))
        self.kept.append(all(len(one) == 1 for one in names) and len(set().union(*names)) == len(names))
        self.delays_s += (first_s - play.start_s)[np.isfinite(first_s)].tolist()
