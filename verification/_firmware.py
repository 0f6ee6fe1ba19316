"""P14 on the reference board's own firmware: its program on an emulated processor, in the modelled circuit.

Besides frames and pressures it shows what a model of a board cannot: the reading error of too short a dwell, as the
program makes it, and the frame rates that ADC clock and line speed leave.
"""

from __future__ import annotations

import tempfile
from itertools import islice
from pathlib import Path

import numpy as np

from ..circuits import adc_codes
from ..common import plots
from ..driver import Skin
from ..emulator import BoardSettings, Contact, PtyPort, Rectangle, Scene, SkinSettings, running
from ..emulator.firmware import (
    BAUD_RATES,
    ERROR_BUDGET_STEPS,
    PRESCALERS_LOG2,
    DwellError,
    check_scene,
    dwell_error,
    fastest_scan,
    line_rate,
    missing_for,
)
from ..emulator.firmware import BoardSettings as FirmwareSettings
from ..errors import InputError
from ._outcome import Check, Figure, Finding, Table, not_run
from ._subject import Subject

RATE_HZ = 50.0
FRAMES = 200
PATIENCE_S = 60.0
"""for one frame: a slow machine is no failure"""
DWELLS_US = (20, 40, 60, 80, 100, 120, 140, 160)
TOUCHED = 0.1
"""of full scale: above it a cell counts as touched"""
SETTLED_FRAMES = 15
"""before and after a change of what is touched, in which places are not compared"""


def firmware_in_the_loop(subject: Subject) -> Finding:
    """Frames, places and pressures through the firmware; dwell, ADC clock and line speed."""
    reason = missing_for()
    if reason is not None:
        return not_run("board firmware", reason)
    try:
        scene = _scene(subject)
        usual = check_scene(scene).dwell_us
    except (InputError, ValueError) as error:
        return not_run("board firmware", f"no firmware for this design: {str(error).splitlines()[-1]}")
    curve = [dwell_error(subject.design, FirmwareSettings(dwell_us=dwell)) for dwell in sorted({*DWELLS_US, usual})]
    own = next(point for point in curve if point.dwell_us == usual)
    apart = max(abs(point.measured_steps - point.predicted_steps) for point in curve) / curve[0].predicted_steps
    return Finding(
        checks=[
            *_received(subject, scene),
            Check(f"reading off from settled, dwell {usual} us", own.measured_steps, ERROR_BUDGET_STEPS, "ADC steps"),
            Check("firmware against settling model, of the largest error", 100 * apart, 5.0, "%"),
        ],
        text=[
            f"The program of the reference board runs on an emulated ATmega328P ({FRAMES} frames at {RATE_HZ:g} Hz "
            "over a pseudo-terminal). The modelled circuit answers each conversion with the voltage at its sample "
            "instant, settling after the row switch included.",
            "Error against dwell: rows of 10 kohm between rows without cells, so that every output jumps at every "
            "step. The model works the same instants out without knowing the program.",
        ],
        figures=[_curve(curve, usual)],
        tables=[_rates(subject), _lines(subject)],
    )


def _scene(subject: Subject) -> Scene:
    full = subject.full_scale_kpa
    rows, columns = subject.design.array.shape
    step = [(0.0, 0.0), (0.5, 0.0), (0.6, full), (2.0, full), (2.1, 0.0)]
    ramp = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.8 * full), (4.0, 0.8 * full)]
    contacts = [
        Contact(cells=[(0, 0)], load_kpa=step),
        Contact(rectangle=Rectangle(center=(rows - 1.0, columns - 1.5), size_cells=(1.0, 2.0)), load_kpa=ramp),
    ]
    board = BoardSettings(frame_rate=RATE_HZ)
    return Scene(skin=SkinSettings(design=subject.design, cell=subject.cell), board=board, contact=contacts)


def _received(subject: Subject, scene: Scene) -> list[Check]:
    """What the driver makes of the bytes of the firmware, beside the truth."""
    full = subject.full_scale_kpa
    with tempfile.TemporaryDirectory() as folder:
        truth_file = Path(folder) / "truth.npz"
        port = PtyPort()
        with (
            running(scene, port, engine="firmware", clock="fast", duration_s=(FRAMES + 25) / RATE_HZ, truth=truth_file),
            Skin.open(port.name, cell=subject.cell, delivery="lossless", timeout=PATIENCE_S) as skin,
        ):
            frames = list(islice(skin, FRAMES))
        with np.load(truth_file) as file:
            truth = {name: file[name] for name in file.files}
    place = {number: k for k, number in enumerate(truth["sequence"].tolist())}
    frames = [frame for frame in frames if frame.sequence in place]
    known = [place[frame.sequence] for frame in frames if frame.sequence is not None]
    sent = adc_codes(subject.design, truth["volts"][known])
    unlike = sum(int((frame.counts != codes).sum()) for frame, codes in zip(frames, sent, strict=True))
    applied = truth["pressure_kpa"][known]
    estimate = np.array([frame.pressure for frame in frames])
    touched = (applied > TOUCHED * full).reshape(len(frames), -1)
    changes = np.r_[False, (touched[1:] != touched[:-1]).any(axis=1)]
    settled = np.convolve(changes, np.ones(2 * SETTLED_FRAMES + 1), mode="same") < 0.5
    wrong = np.isnan(estimate) | ((estimate > TOUCHED * full) != (applied > TOUCHED * full))
    rmse = 100 * np.sqrt(np.mean((estimate - applied) ** 2, axis=0)).max() / full
    limit = subject.design.requirements.pressure_rmse_percent
    return [
        Check("frames received", float(len(frames)), float(FRAMES), at_least=True),
        Check("frames lost", float(sum(frame.lost_before or 0 for frame in frames)), 0.0),
        Check("counts that differ from what was converted", float(unlike), 0.0),
        Check("cells wrongly shown as touched or untouched", 100 * float(wrong[settled].mean()), 1.0, "%"),
        Check("pressure RMSE, worst cell", float(rmse), 2 * limit, "% of full scale"),
    ]


def _curve(curve: list[DwellError], usual: int) -> Figure:
    dwells = [point.dwell_us for point in curve]
    with plots.drawing(1, 1) as (figure, axes):
        panel = axes[0, 0]
        panel.semilogy(dwells, [point.predicted_steps for point in curve], label="settling model")
        panel.semilogy(dwells, [point.measured_steps for point in curve], "o", label="firmware in the loop")
        panel.axhline(ERROR_BUDGET_STEPS, color=plots.INK, lw=0.8, ls=":", label="budget")
        panel.axvline(usual, color=plots.INK, lw=0.8, ls="--", label="dwell of the board")
        panel.set(xlabel="dwell / us", ylabel="largest error / ADC steps")
        panel.legend()
        return Figure(plots.svg(figure), "Reading error against dwell: the firmware's, and the settling model's.")


def _rates(subject: Subject) -> Table:
    rows = []
    for prescaler in PRESCALERS_LOG2:
        rate = fastest_scan(subject.design, prescaler)
        rows.append([f"{rate.adc_clock_hz / 1e3:g} kHz", f"{rate.dwell_us} us", f"{rate.frames_per_s:.0f}"])
    caption = f"Fastest scan within {ERROR_BUDGET_STEPS:g} ADC steps of settled, 1 000 000 baud"
    return Table(["ADC clock", "shortest dwell", "frames/s"], rows, caption)


def _lines(subject: Subject) -> Table:
    rows = []
    for baud in BAUD_RATES:
        arriving, dropped = line_rate(subject.design, baud)
        rows.append([str(baud), f"{arriving:.0f}", f"{dropped:.0f}"])
    return Table(["baud", "frames/s that arrive", "frames/s dropped"], rows, "Frame rate at the board's usual dwell")
