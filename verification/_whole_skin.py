"""P14: a whole skin, from contacts over a serial port to pressures."""

from __future__ import annotations

import tempfile
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..circuits import Requirement, adc_codes
from ..common.archives import Stored, read_arrays
from ..common.arrays import BoolArray
from ..driver import Skin
from ..emulator import BoardSettings, Contact, EngineName, PtyPort, Rectangle, Scene, SkinSettings, running
from ..emulator.firmware import (
    ERROR_BUDGET_STEPS,
    check_scene,
    dwell_error,
    missing_for,
)
from ..emulator.firmware import BoardSettings as FirmwareSettings
from ..errors import InputError
from ._catalogue import CATALOGUE
from ._claim import statement
from ._dut import DesignUnderTest
from ._hardware import FRAMES, PATIENCE_S, readings_of
from ._outcome import Check, Figure, Finding, NotRun, Table, drawn
from ._pictures import heat_maps
from ._pressures import FASTEST_HZ, SECONDS, TOUCHED, Run, contacts, traces

DWELLS_US = (20, 40, 80, 160)
NEAR_S = 0.3
"""from a change of what is touched, in which an estimate may show the change before or after"""
_MOST_BYTES = 2**30
_TRUE = {
    "sequence": Stored("whole numbers", ("frames",)),
    "pressure_kpa": Stored("numbers", ("frames", "rows", "columns")),
    "volts": Stored("numbers", ("frames", "rows", "columns"), nan=True),
}
"""what is read of the emulator's truth"""


class _Received(NamedTuple):
    """What the driver made of a board's frames, beside the truth."""

    run: Run
    lost: int
    """frames"""
    unlike: int
    """counts that differ from those sent"""

    def checks(self, dut: DesignUnderTest, count: int, unlike: str) -> list[Check]:
        """What holds for ``count`` frames of every emulated board."""
        run, limit = self.run, dut.design.requirements
        rmse = 100 * float(np.sqrt(np.mean(run.error**2, axis=0)).max())
        estimated = run.estimated_kpa
        wrong = np.isnan(estimated) | ((estimated > TOUCHED * run.full_scale_kpa) != run.touched)
        misplaced = 100 * float(wrong[_settled(run.touched)].mean())
        return [
            Check("pressure RMSE, worst cell", rmse, 2 * limit.pressure_rmse_percent, "% of full scale"),
            Check("cells wrongly shown as touched or untouched", misplaced, 1.0, "%"),
            Check(unlike, float(self.unlike), 0.0),
            Check("frames lost", float(self.lost), 0.0),
            Check("frames received", float(len(run.time_s)), float(count), at_least=True),
        ]


@statement(
    *("P14", "A whole skin in real time", "I, VIII"),
    "Several contacts at once, their places and their pressures, in real time.",
)
def whole_skin(dut: DesignUnderTest) -> Finding:
    match dut.target:
        case "emulated":
            return _emulated(dut)
        case "firmware":
            return _firmware(dut)
        case _:
            return _hardware(dut)


def _emulated(dut: DesignUnderTest) -> Finding:
    """A board on a pseudo-terminal, for packets, driver, places and pressures."""
    count = round(SECONDS * FASTEST_HZ)
    operated = dut.at_rate(FASTEST_HZ)
    scene = _scene(operated, contacts(operated.design.array.shape, operated.full_scale_kpa), noise=0.5)
    received = _receive(scene, operated, engine="model", count=count)
    return Finding(
        checks=[
            *received.checks(operated, count, "counts that differ from what the board sent"),
            *_fast_enough(operated),
        ],
        text=[
            f"The virtual board scans a skin with {len(scene.contact)} contacts "
            f"{FASTEST_HZ:g} times a second and sends packets over a pseudo-terminal; the driver opens it like any "
            "serial port, learns the design from the board, and estimates the pressure of every cell. A cell counts as "
            f"touched above {100 * TOUCHED:g} % of full scale; frames within {NEAR_S:g} s of a change are left out of "
            "that comparison. Time is the board's: this machine's speed decides nothing.",
        ],
        figures=[*traces(received.run), *drawn(lambda: _snapshot(received.run))],
    )


def _fast_enough(dut: DesignUnderTest) -> list[Check]:
    """The fastest scan that settles to a quarter of an ADC step; nothing where the design does not say enough."""
    try:
        found = CATALOGUE["fastest_scan"].compute(
            dut, Requirement(id="P14", quantity="fastest_scan", min=FASTEST_HZ), "worst-case"
        )
    except NotRun:
        return []
    return [Check("fastest scan settled to 1/4 ADC step", found.value, FASTEST_HZ, "frames/s", at_least=True)]


def _receive(scene: Scene, dut: DesignUnderTest, *, engine: EngineName, count: int) -> _Received:
    """Frames of an emulated board on a pseudo-terminal, beside the truth that it writes."""
    with tempfile.TemporaryDirectory() as folder:
        truth_file = Path(folder) / "truth.npz"
        port = PtyPort()
        # The board lives a little longer than what the host takes, so that it never waits for a last frame.
        with (
            running(scene, port, engine=engine, clock="fast", duration_s=(count + 50) / FASTEST_HZ, truth=truth_file),
            Skin.open(port.name, cell=dut.cell, delivery="lossless", timeout=PATIENCE_S) as skin,
        ):
            frames = list(islice(skin, count))
        truth = read_arrays(truth_file, _TRUE, what="truth file", most_bytes=_MOST_BYTES)
    place = {number: k for k, number in enumerate(truth["sequence"].tolist())}
    frames = [frame for frame in frames if frame.sequence in place]
    known = [place[frame.sequence] for frame in frames if frame.sequence is not None]
    sent = adc_codes(dut.design, truth["volts"][known])
    unlike = sum(int((frame.counts != codes).sum()) for frame, codes in zip(frames, sent, strict=True))
    run = Run(
        "the emulated board",
        time_s=np.array([frame.device_time for frame in frames]),
        applied_kpa=truth["pressure_kpa"][known],
        estimated_kpa=np.array([frame.pressure for frame in frames]),
        lost=np.array([~frame.valid for frame in frames]),
        full_scale_kpa=dut.full_scale_kpa,
    )
    return _Received(run, sum(frame.lost_before or 0 for frame in frames), unlike)


def _firmware(dut: DesignUnderTest) -> Finding:
    """P14 on the reference board's own program, on an emulated processor in the modelled circuit.

    Besides frames and pressures it has the reading error of too short a dwell, as the program makes it.
    """
    reason = missing_for()
    if reason is not None:
        raise NotRun(reason)
    try:
        scene = _scene(dut, _brief_contacts(dut.design.array.shape, dut.full_scale_kpa), noise=0.0)
        usual = check_scene(scene).dwell_us
    except (InputError, ValueError) as error:
        raise NotRun(f"no firmware for this design: {str(error).splitlines()[-1]}") from error
    curve = [dwell_error(dut.design, FirmwareSettings(dwell_us=dwell)) for dwell in sorted({*DWELLS_US, usual})]
    own = next(point for point in curve if point.dwell_us == usual)
    apart = max(abs(point.measured_steps - point.predicted_steps) for point in curve) / curve[0].predicted_steps
    received = _receive(scene, dut, engine="firmware", count=FRAMES)
    return Finding(
        checks=[
            *received.checks(dut, FRAMES, "counts that differ from what was converted"),
            Check(f"reading off from settled, dwell {usual} us", own.measured_steps, ERROR_BUDGET_STEPS, "ADC steps"),
            Check("firmware against settling model, of the largest error", 100 * apart, 5.0, "%"),
        ],
        text=[
            "The program of the reference board runs on an emulated ATmega328P and sends over a pseudo-terminal. The "
            "modelled circuit answers each conversion with the voltage at its sample instant, settling after the row "
            "switch included.",
        ],
        figures=traces(received.run),
        tables=[
            Table(
                ["dwell", "largest error of the firmware", "of the settling model"],
                [
                    [f"{p.dwell_us} us", f"{p.measured_steps:.3g} steps", f"{p.predicted_steps:.3g} steps"]
                    for p in curve
                ],
                "Rows of 10 kohm between rows without cells, so that every output jumps at every step.",
            )
        ],
    )


def _brief_contacts(shape: tuple[int, int], full: float) -> list[Contact]:
    """Two contacts within four seconds, since an emulated processor takes its time."""
    step = [(0.0, 0.0), (0.5, 0.0), (0.6, full), (2.0, full), (2.1, 0.0)]
    ramp = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.8 * full), (4.0, 0.8 * full)]
    beside = Rectangle(center=(shape[0] - 1.0, shape[1] - 1.5), size_cells=(1.0, 2.0))
    return [Contact(cells=[(0, 0)], load_kpa=step), Contact(rectangle=beside, load_kpa=ramp)]


def _hardware(dut: DesignUnderTest) -> Finding:
    """What can be said of a real board without knowing what presses on it."""
    readings = readings_of(dut)
    if not len(readings.device_steps):
        raise NotRun("the board numbers no frames and states no times")
    count, shortest = len(readings.volts), float(readings.device_steps.min())
    return Finding(
        checks=[
            Check(f"frames lost, of {count}", float(readings.lost), 0.0),
            Check("valid cells", 100 * readings.valid, 95.0, "%", at_least=True),
            Check("device time goes forward: shortest step", shortest, 1e-6, "s", at_least=True),
            Check("applied pressures", None, 0.0, reason="not known for a real board"),
        ],
    )


def _scene(dut: DesignUnderTest, pressing: list[Contact], noise: float) -> Scene:
    """A skin of the design's cells under some contacts, read with ``noise`` in ADC steps."""
    if dut.design.adc is None:
        raise InputError("the design has no [adc] section; a board sends counts")
    board = BoardSettings(frame_rate=FASTEST_HZ, noise=noise * dut.design.adc.step)
    return Scene(skin=SkinSettings(design=dut.design, cell=dut.cell), board=board, contact=pressing)


def _settled(touched: BoolArray) -> BoolArray:
    """(frames,) where no cell has come to be touched (frames, rows, columns) or untouched within :data:`NEAR_S`."""
    cells = touched.reshape(len(touched), -1)
    changes = np.r_[False, (cells[1:] != cells[:-1]).any(axis=1)]
    near = np.convolve(changes, np.ones(2 * round(NEAR_S * FASTEST_HZ) + 1), mode="same")
    settled: BoolArray = near < 0.5
    return settled


def _snapshot(run: Run) -> Figure:
    applied, full = run.applied_kpa, run.full_scale_kpa
    busiest = int(np.argmax(run.touched.sum(axis=(1, 2)) + applied.sum(axis=(1, 2)) / (1e3 * full)))
    estimate = run.estimated_kpa[busiest]
    maps = {"applied": applied[busiest], "estimated": estimate, "difference": estimate - applied[busiest]}
    return Figure(
        heat_maps(maps, label="kPa", limit=full, size=2.3),
        f"All cells at {run.time_s[busiest]:.2f} s, when more of them are touched than at any other time.",
    )
