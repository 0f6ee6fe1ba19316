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

import numpy as np

from ..cell import Cell
from ..common.arrays import FloatArray
from ..driver import Contact
from ._driver import design
from ._taps import contacts_of
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
class Fingers:
    """One scene on one board."""

    size: int = field(metadata=column("cells", "{0} x {0}"))
    """of the N x N array"""
    circuit: str = field(metadata=column("circuit", "{}", width=18))
    idle_rows: str = field(metadata=column("idle", "{}", width=6))
    bits: int = field(metadata=column("bits", "{}"))
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
    places: FloatArray
    """(fingers, frames, 2) rows and columns, in the frames of the whole stream"""
    peaks_kpa: FloatArray
    """(fingers, frames)"""


def fingers(sizes: Iterable[int], *, scenes: Iterable[Scene] = SCENES, seed: int = 0) -> Iterator[Fingers]:
    """Play each scene on each of the :data:`BOARDS`, at sizes of :data:`LEAST_SIZE` and more."""
    scenes = tuple(scenes)
    for size in sizes:
        if size < LEAST_SIZE:
            continue
        for board in BOARDS:
            for scene in scenes:
                yield played(size, board, scene, np.random.default_rng(seed))


def played(size: int, board: tuple[str, str, int, float], scene: Scene, rng: np.random.Generator) -> Fingers:
    """Play one scene on one board."""
    circuit, idle_rows, bits, noise_mv = board
    readout = design(size, circuit, idle_rows, bits)
    pitch_mm = 1e3 * (readout.sheet.pitch or 1.0)
    seconds = REST_S + scene.plays * (scene.seconds + REST_S)
    each = scene.substeps
    fine_s = np.arange(1.0, each * round(seconds * RATE_HZ) + 1) / (each * RATE_HZ)
    time_s = fine_s[each - 1 :: each]
    plays = [_play(k, scene, size, fine_s, rng) for k in range(scene.plays)] if scene.ways else []
    loads = [_loads(play, scene, (size, size)) for play in plays]
    kpa = np.sum(loads, axis=(0, 1)) if loads else np.zeros((len(fine_s), size, size))
    dt_s = np.full(len(fine_s), 1.0 / (each * RATE_HZ))
    ohm: FloatArray = Cell.example().forward((size, size)).run(dt_s, kpa)[each - 1 :: each]
    loads = [load[:, each - 1 :: each] for load in loads]
    if scene.dead_row:
        ohm[:, size // 2] = np.inf
    if scene.drifting:
        drift = 1.0 + DRIFT * np.clip((time_s - REST_S) / scene.seconds, 0.0, 1.0)
        where = (slice(None), slice(None)) if scene.drifting == "all" else (size // 2, size // 3)
        ohm[(slice(None), *where)] *= drift.reshape((-1,) + (1,) * (ohm[(0, *where)].ndim))
    seen = list(contacts_of(readout, ohm, noise_mv, RATE_HZ, rng))
    found, delays, kept, own, forces, off = [], [], [], 0, [], []
    for play, load in zip(plays, loads, strict=True):
        judged = _judge(play, load, seen, time_s, pitch_mm)
        found += judged.found
        delays += judged.delays_s
        kept.append(judged.kept)
        own += len(load)
        forces += judged.force_shares
        off += judged.off_cells
    ids = {contact.id for _, contacts in seen for contact in contacts}
    return Fingers(
        size=size,
        circuit=circuit,
        idle_rows=idle_rows,
        bits=bits,
        noise_mv=noise_mv,
        scene=scene.name,
        found_percent=100.0 * float(np.mean(found)) if found else np.nan,
        delay_ms=1e3 * float(np.median(delays)) if delays else np.nan,
        ids_kept_percent=100.0 * float(np.mean(kept)) if kept else np.nan,
        false=max(len(ids) - own, 0),
        false_s=sum(bool(contacts) and not _touched(plays, now_s) for now_s, contacts in seen) / RATE_HZ,
        force_share=float(np.median(forces)) if forces else np.nan,
        off_cells=float(np.median(off)) if off else np.nan,
    )


def _play(number: int, scene: Scene, size: int, time_s: FloatArray, rng: np.random.Generator) -> Play:
    assert scene.ways is not None
    start_s = REST_S + number * (scene.seconds + REST_S)
    end_s = start_s + scene.seconds
    places = (size - 1) / 2.0 + scene.ways(np.clip((time_s - start_s) / scene.seconds, 0.0, 1.0), rng)
    if scene.on_cells:
        places = np.round(places)
    edge_s = min(EDGE_S, scene.seconds / 6.0)
    down = np.interp(time_s, [start_s, start_s + edge_s, end_s - edge_s, end_s], [0.0, 1.0, 1.0, 0.0])
    peaks = Cell.example().full_scale_kpa * rng.uniform(*scene.peaks, len(places))
    return Play(start_s, end_s, edge_s, places, peaks[:, None] * down)


def _touched(plays: list[Play], time_s: float) -> bool:
    return any(play.start_s <= time_s <= play.end_s + LATE_S for play in plays)


def _loads(play: Play, scene: Scene, shape: tuple[int, int]) -> FloatArray:
    """(fingers, frames, rows, columns) kPa."""
    row, column = np.indices(shape)
    away = (row - play.places[:, :, 0, None, None]) ** 2 + (column - play.places[:, :, 1, None, None]) ** 2
    # The mean of a bell over a cell is nearly a bell that is wider by the variance of the cell's own width.
    variance = scene.width_cells**2 + (0.0 if scene.on_cells else 1.0 / 12.0)
    load: FloatArray = play.peaks_kpa[:, :, None, None] * np.exp(-away / (2.0 * variance))
    load[load < 1e-3] = 0.0
    return load


@dataclass(frozen=True)
class _Judged:
    found: list[bool]
    delays_s: list[float]
    kept: bool
    force_shares: list[float]
    off_cells: list[float]


def _judge(
    play: Play,
    load: FloatArray,
    seen: list[tuple[float, tuple[Contact, ...]]],
    time_s: FloatArray,
    pitch_mm: float,
) -> _Judged:
    """Compare contacts with the fingers of one play."""
    first_s = np.full(len(load), np.inf)
    found: list[bool] = []
    names: list[set[int]] = [set() for _ in load]
    force_shares, off_cells = [], []
    rows, columns = np.indices(load.shape[2:])
    for now_s, contacts in seen:
        if not play.start_s < now_s < play.end_s - play.edge_s / 2:
            continue
        frame = min(round(now_s * RATE_HZ), len(time_s) - 1)
        held = now_s > play.start_s + play.edge_s + LATE_S or now_s > play.start_s + (play.end_s - play.start_s) / 2
        for finger, kpa in enumerate(load[:, frame]):
            total = kpa.sum()
            if not total:
                continue
            centre = float((rows * kpa).sum() / total), float((columns * kpa).sum() / total)
            far = [math.dist(centre, (one.y_mm / pitch_mm, one.x_mm / pitch_mm)) for one in contacts]
            here = [one for one, away in zip(contacts, far, strict=True) if away < NEAR_CELLS + 2.0 * bool(one.joined)]
            if held:
                found.append(bool(here))
            if not here:
                continue
            first_s[finger] = min(first_s[finger], now_s)
            contact = contacts[int(np.argmin(far))]
            if held and not contact.joined and min(far) < NEAR_CELLS:
                names[finger].add(contact.id)
                if len(contacts) == len(load):
                    off_cells.append(min(far))
                    force_shares.append(contact.force_n / (1e-3 * float(total) * pitch_mm**2))
    kept = all(len(one) == 1 for one in names) and len(set().union(*names)) == len(names)
    delays = (first_s - play.start_s)[np.isfinite(first_s)].tolist()
    return _Judged(found, delays, kept, force_shares, off_cells)
