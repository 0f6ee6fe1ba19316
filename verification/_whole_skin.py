"""P14: a whole skin, from contacts over a serial port to pressures."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from ..circuits import adc_codes
from ..common import plots
from ..common.arrays import BoolArray, FloatArray
from ..driver import Frame, Skin
from ..emulator import BoardSettings, Contact, PtyPort, Rectangle, Scene, SkinSettings, running
from ..errors import InputError
from ._chain import runs
from ._firmware import firmware_in_the_loop
from ._maps import heat_maps
from ._outcome import Check, Figure, Finding, NotRun
from ._subject import Subject
from ._timing import timing

RATE_HZ = 50.0
SECONDS = 26.0
PATIENCE_S = 60.0
"""for one frame: a slow machine is no failure"""
TOUCHED = 0.1  # of full scale: above it a cell counts as touched


@dataclass(frozen=True)
class _Received:
    """What the driver made of a board's frames, beside the truth."""

    scene: Scene
    frames: list[Frame]
    applied: FloatArray
    """(frames, rows, columns) kPa"""
    unlike: int
    """counts that differ from those sent"""
    misplaced: float
    """share of cells wrongly shown as touched or untouched"""


def whole_skin(subject: Subject) -> Finding:
    """P14: several contacts at once, their places and pressures, in real time."""
    match subject.target:
        case "emulated":
            return _emulated(subject)
        case "firmware":
            return firmware_in_the_loop(subject)
        case _:
            return _hardware(subject)


def _emulated(subject: Subject) -> Finding:
    """The chain in board time for the pressures; a board on a pseudo-terminal for packets, driver and places."""
    limit = subject.design.requirements.pressure_rmse_percent
    operated = subject.at_rate(RATE_HZ)
    histories = runs(operated)
    rmse, peak = (100 * max(found) for found in zip(*((h.rmse()[0], h.peak()[0]) for h in histories), strict=True))
    lost = 100 * max(float(history.lost.mean()) for history in histories)
    received = _receive(operated)
    frames = received.frames
    speed = timing(operated, RATE_HZ)
    return Finding(
        checks=[
            Check("pressure RMSE, worst cell while touched", rmse, 2 * limit, "% of full scale"),
            Check("pressure, peak error of any cell", peak, 4 * limit, "% of full scale"),
            Check("readings lost to a limit", lost, 0.0, "%"),
            Check("cells wrongly shown as touched or untouched", 100 * received.misplaced, 1.0, "%"),
            Check("counts that differ from what the board sent", float(received.unlike), 0.0),
            Check("frames lost", float(sum(frame.lost_before or 0 for frame in frames)), 0.0),
            Check("frames received", float(len(frames)), SECONDS * RATE_HZ, at_least=True),
            *speed.checks,
        ],
        text=[
            "Pressures: boards at the worst corner of their tolerances and drawn at random, with the design's noise, "
            "settling and converter, read by a host that knows nominal parts and each cell's resistance at rest.",
            f"Places and packets: the virtual board scans a skin with {len(received.scene.contact)} contacts "
            f"{RATE_HZ:g} times a second and sends packets over a pseudo-terminal; the driver opens it like any serial "
            "port, learns the design from the board, and estimates the pressure of every cell. A cell counts as "
            f"touched above {100 * TOUCHED:g} % of full scale; frames within 0.3 s of a change are left out of that "
            "comparison. Time is the board's: this machine's speed decides nothing.",
            *speed.text,
        ],
        figures=[
            _traces(received, subject.full_scale_kpa),
            _snapshot(received, subject.full_scale_kpa),
            *speed.figures,
        ],
        tables=speed.tables,
    )


def _receive(subject: Subject) -> _Received:
    scene = _scene(subject)
    full = subject.full_scale_kpa
    with tempfile.TemporaryDirectory() as folder:
        truth_file = Path(folder) / "truth.npz"
        port = PtyPort()
        # The board lives a little longer than what the host takes, so that it never waits for a last frame.
        with (
            running(scene, port, clock="fast", duration_s=SECONDS + 1.0, truth=truth_file),
            Skin.open(port.name, delivery="lossless", timeout=PATIENCE_S) as skin,
        ):
            frames = list(islice(skin, round(SECONDS * RATE_HZ)))
        with np.load(truth_file) as file:
            truth = {name: file[name] for name in file.files}
    frames = [frame for frame in frames if (frame.sequence or 0) < len(truth["sequence"])]
    applied = truth["pressure_kpa"][[frame.sequence for frame in frames]]
    estimate = np.array([frame.pressure for frame in frames])
    sent = adc_codes(subject.design, truth["volts"])
    unlike = sum(int((frame.counts != sent[frame.sequence]).sum()) for frame in frames)
    wrong = np.isnan(estimate) | ((estimate > TOUCHED * full) != (applied > TOUCHED * full))
    return _Received(scene, frames, applied, unlike, float(wrong[_settled(applied, full)].mean()))


def _hardware(subject: Subject) -> Finding:
    """What can be said of a real board without knowing what presses on it."""
    with Skin.open(subject.target, board=subject.board, baudrate=subject.baud, delivery="every") as skin:
        if not skin.family.has_device_time:
            raise NotRun(f"a board '{skin.family.name}' numbers no frames and tells no times")
        start = time.perf_counter()
        frames = list(islice(skin, 200))
        elapsed = time.perf_counter() - start
    lost = sum(frame.lost_before or 0 for frame in frames[1:])
    valid = np.mean([frame.valid.mean() for frame in frames])
    steps = np.diff([frame.device_time for frame in frames])
    return Finding(
        checks=[
            Check("frames lost, of 200", float(lost), 0.0),
            Check("valid cells", 100 * float(valid), 95.0, "%", at_least=True),
            Check("device time goes forward: shortest step", float(steps.min()), 1e-6, "s", at_least=True),
            Check("applied pressures", None, 0.0, reason="not known for a real board"),
        ],
        text=[f"200 frames from {subject.target} in {elapsed:.1f} s."],
    )


def _scene(subject: Subject) -> Scene:
    """Three contacts that overlap in time, on whatever array the design has."""
    if subject.design.adc is None:
        raise InputError("the design has no [adc] section; a board sends counts")
    rows, columns = subject.design.array.shape
    full = subject.full_scale_kpa

    def load(start: float, end: float, level: float) -> list[tuple[float, float]]:
        return [(start, 0.0), (start + 0.1, level * full), (end, level * full), (end + 0.1, 0.0)]

    contacts = [
        Contact(cells=[(0, 0)], load_kpa=load(2.0, 14.0, 1.0)),
        Contact(cells=[(rows - 1, columns // 2)], load_kpa=[*load(5.0, 9.0, 0.6), *load(12.0, 20.0, 0.9)]),
        Contact(
            rectangle=Rectangle(center=(rows / 2, columns - 1.0), size_cells=(2.0, 1.0)),
            load_kpa=[(8.0, 0.0), (16.0, 0.8 * full), (24.0, 0.8 * full), (24.1, 0.0)],
        ),
    ]
    board = BoardSettings(frame_rate=RATE_HZ, noise=subject.design.adc.step / 2)
    return Scene(skin=SkinSettings(design=subject.design, cell=subject.cell), board=board, contact=contacts)


def _settled(applied: FloatArray, full: float) -> BoolArray:
    """(frames,) where no cell's load has crossed the touch level within 0.3 s."""
    touched = (applied > TOUCHED * full).reshape(len(applied), -1)
    changes = np.r_[False, (touched[1:] != touched[:-1]).any(axis=1)]
    near = np.convolve(changes, np.ones(2 * round(0.3 * RATE_HZ) + 1), mode="same")
    settled: BoolArray = near < 0.5
    return settled


def _traces(received: _Received, full: float) -> Figure:
    frames, applied = received.frames, received.applied
    contacts = received.scene.contact
    places = sorted({tuple(np.argwhere(c.coverage(applied.shape[1:]) > 0)[0].tolist()) for c in contacts})
    times = [frame.device_time for frame in frames]
    with plots.drawing(len(places), 1, height=1.0 + 1.3 * len(places), sharex=True) as (figure, axes):
        for panel, (row, column) in zip(axes[:, 0], places, strict=True):
            panel.plot(times, applied[:, row, column], color=plots.INK, lw=4, alpha=0.25, label="applied")
            panel.plot(times, [frame.pressure[row, column] for frame in frames], lw=1, label="driver's estimate")
            panel.set(title=f"cell ({row}, {column})", ylabel="kPa", ylim=(-0.1 * full, 1.2 * full))
        axes[0, 0].legend(ncols=2, loc="upper right")
        axes[-1, 0].set_xlabel("device time / s")
        return Figure(plots.svg(figure), "One cell of each contact, through board, port, driver and estimator.")


def _snapshot(received: _Received, full: float) -> Figure:
    frames, applied = received.frames, received.applied
    busiest = int(np.argmax((applied > TOUCHED * full).sum(axis=(1, 2)) + applied.sum(axis=(1, 2)) / (1e3 * full)))
    estimate = frames[busiest].pressure
    maps = {"applied": applied[busiest], "estimated": estimate, "difference": estimate - applied[busiest]}
    return Figure(
        heat_maps(maps, label="kPa", limit=full, size=2.3),
        f"All cells at {frames[busiest].device_time:.2f} s, when more of them are touched than at any other time.",
    )
