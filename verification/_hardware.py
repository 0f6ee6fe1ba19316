"""Quantities measured on a board (the firmware, or behind a port), beside what the simulation says of the same.

The board is untouched, or carries a jig of known resistors (``--jig CELLS.csv``). Readings are taken as counts and made
into resistances by the law of the ideal circuit, as the simulated quantities are.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from ..circuits import Requirement, adc_codes, apparent_resistance, clipped, scan, volts_of_codes
from ..common.arrays import FloatArray
from ..driver import Frame, Skin
from ..emulator import BoardSettings, PtyPort, Scene, SkinSettings
from ..emulator.firmware import check_scene, running_firmware
from ..errors import LinkError, MissingExtra, ProtocolError
from ._dynamic import reading_noise
from ._outcome import Measurement, NotRun
from ._subject import Subject
from ._units import engineering

FRAMES = 200
PATIENCE_S = 30.0
"""for one frame: a slow machine is no failure"""
MEASURABLE = ("reading_error", "noise", "adc_headroom", "lost_readings", "lost_frames", "fastest_scan")
CLOCK_TICK_S = 1e-6
"""of the device times in frames"""
BOARD_SUFFIX = "-board"
"""of the id of a requirement that is measured beside its simulation"""


@dataclass(frozen=True)
class Readings:
    """Frames of an unchanging skin."""

    volts: FloatArray
    """(frames, rows, columns)"""
    clipped: FloatArray
    """(frames, rows, columns) 1 where a code is the first or the last"""
    lost: int
    device_seconds: float | None
    """from the first frame to the last, by the board's clock"""


def twins(subject: Subject, requirements: tuple[Requirement, ...]) -> tuple[Requirement, ...]:
    """The requirements and, after each that a board can show, the same to be measured on the target."""
    if subject.target == "emulated":
        return requirements
    both = []
    for requirement in requirements:
        both.append(requirement)
        if requirement.quantity in MEASURABLE and requirement.method != "hardware":
            both.append(requirement.replace(id=f"{requirement.id}{BOARD_SUFFIX}", method="hardware"))
    return tuple(both)


def measured_on_board(subject: Subject, requirement: Requirement) -> Measurement:
    """One quantity of the catalogue, measured on the target of this run.

    Raises:
        NotRun: the quantity cannot be measured, there is no board, or no jig where the true resistances matter.
    """
    quantity = requirement.quantity
    if subject.target == "emulated":
        raise NotRun("no board: --target names a port, or the firmware")
    if quantity not in MEASURABLE:
        raise NotRun(f"'{quantity}' cannot be measured on a board; expected one of {', '.join(MEASURABLE)}")
    if subject.design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    if quantity == "reading_error" and subject.jig is None:
        raise NotRun("no known resistors on the board: --jig CELLS.csv says what they are")
    readings = _readings(subject)
    found = _MEASURE[quantity](subject, readings)
    source = f"{len(readings.volts)} frames of the board at {subject.target}"
    if found.resolution:
        source += f"; resolution {engineering(found.resolution, found.unit, 2)}"
    return replace(found, confidence=source)


def _reading_error(subject: Subject, readings: Readings) -> Measurement:
    jig = subject.jig
    assert jig is not None
    ohms = apparent_resistance(subject.design, readings.volts.mean(axis=0))
    error = np.abs(ohms / jig - 1.0)
    nominal = apparent_resistance(subject.design, scan(subject.design, jig).volts)
    place = np.unravel_index(int(np.argmax(error)), error.shape)
    simulated = 100 * float(np.abs(nominal / jig - 1.0)[place])
    mean = readings.volts.mean(axis=0)
    half_step = subject.design.adc.step / 2 if subject.design.adc is not None else 0.0
    ends = [apparent_resistance(subject.design, mean + sign * half_step)[place] for sign in (-1.0, 1.0)]
    return Measurement(
        100 * float(error[place]),
        "%",
        where=f"cell {tuple(map(int, place))}: {engineering(float(ohms[place]), 'ohm')} read",
        resolution=50 * float(abs(ends[1] - ends[0]) / jig[place]),
        text=[f"Simulated with nominal parts: {engineering(simulated, '%')} at that cell."],
    )


def _noise(subject: Subject, readings: Readings) -> Measurement:
    scatter = readings.volts.std(axis=0, ddof=1)
    place = np.unravel_index(int(np.argmax(scatter)), scatter.shape)
    try:
        asked = Requirement(id="noise", quantity="noise")
        simulated = [f"Simulated: {engineering(reading_noise(subject, asked, 'nominal').value, 'V')}."]
    except NotRun as missing:
        simulated = [f"Not simulated: {missing}."]
    sigma = float(scatter[place])
    where = f"cell {tuple(map(int, place))}"
    frames = len(readings.volts)  # one standard error of a standard deviation
    return Measurement(sigma, "V", where=where, text=simulated, resolution=sigma / (2.0 * (frames - 1)) ** 0.5)


def _adc_headroom(subject: Subject, readings: Readings) -> Measurement:
    adc = subject.design.adc
    assert adc is not None
    below, above = readings.volts.min() - adc.range[0] - adc.step, adc.range[1] - adc.step - readings.volts.max()
    nominal = scan(subject.design, _true_cells(subject)).volts
    simulated = min(nominal.min() - adc.range[0] - adc.step, adc.range[1] - adc.step - nominal.max())
    return Measurement(
        float(min(below, above)),
        "V",
        where=f"readings from {engineering(float(readings.volts.min()), 'V')} "
        f"to {engineering(float(readings.volts.max()), 'V')}",
        text=[f"Simulated with nominal parts: {engineering(float(simulated), 'V')}."],
    )


def _lost_readings(subject: Subject, readings: Readings) -> Measurement:
    nominal = clipped(subject.design, adc_codes(subject.design, scan(subject.design, _true_cells(subject)).volts))
    return Measurement(
        100 * float(readings.clipped.mean()),
        "%",
        where=f"{int(readings.clipped.any(axis=0).sum())} cells",
        text=[f"Simulated with nominal parts: {engineering(100 * float(nominal.mean()), '%')}."],
    )


def _lost_frames(subject: Subject, readings: Readings) -> Measurement:
    sent = len(readings.volts) + readings.lost
    return Measurement(100 * readings.lost / sent, "%", where=f"{readings.lost} of {sent} frames")


def _frame_rate(subject: Subject, readings: Readings) -> Measurement:
    if not readings.device_seconds:
        raise NotRun("the board tells no time")
    rate = (len(readings.volts) + readings.lost - 1) / readings.device_seconds
    tick = 2.0 * CLOCK_TICK_S / readings.device_seconds  # at both ends
    text = ["The rate at which this board scans."]
    return Measurement(rate, "Hz", where="by the board's clock", text=text, resolution=rate * tick)


_MEASURE = {
    "reading_error": _reading_error,
    "noise": _noise,
    "adc_headroom": _adc_headroom,
    "lost_readings": _lost_readings,
    "lost_frames": _lost_frames,
    "fastest_scan": _frame_rate,
}


def _true_cells(subject: Subject) -> FloatArray:
    return np.full(subject.design.array.shape, subject.rest) if subject.jig is None else subject.jig


def _readings(subject: Subject) -> Readings:
    if "readings" not in subject.memo:
        try:
            with (
                _board(subject) as port,
                Skin.open(
                    port, board=subject.board, baudrate=subject.baud, delivery="every", timeout=PATIENCE_S
                ) as skin,
            ):
                if skin.shape != subject.design.array.shape:
                    raise NotRun(f"the board has {skin.shape} cells, the design {subject.design.array.shape}")
                frames: list[Frame] = list(islice(skin, FRAMES))
        except (LinkError, ProtocolError, MissingExtra) as error:
            raise NotRun(f"no board: {error}") from error
        subject.memo["readings"] = _taken(subject, frames)
    found: Readings = subject.memo["readings"]
    return found


def _taken(subject: Subject, frames: list[Frame]) -> Readings:
    counts = np.array([frame.counts for frame in frames])
    times = [frame.device_time for frame in frames if frame.device_time is not None]
    return Readings(
        volts=volts_of_codes(subject.design, counts),
        clipped=clipped(subject.design, counts).astype(np.float64),
        lost=sum(frame.lost_before or 0 for frame in frames[1:]),
        device_seconds=times[-1] - times[0] if len(times) > 1 else None,
    )


@contextmanager
def _board(subject: Subject) -> Iterator[str]:
    """The name of a port with the target behind it."""
    if subject.target != "firmware":
        yield subject.target
        return
    rate = subject.design.operation.frame_rate or 50.0
    cell = subject.cell if subject.jig is None else subject.cell.replace(rest_resistance_ohm=float(subject.jig.mean()))
    if subject.jig is not None and (subject.jig != subject.jig.flat[0]).any():
        raise NotRun("an emulated board has cells of one resistance at rest; expected a jig of equal resistors")
    step = subject.design.adc.step if subject.design.adc else 0.0
    scene = Scene(
        skin=SkinSettings(design=subject.design, cell=cell), board=BoardSettings(frame_rate=rate, noise=step / 4)
    )
    check_scene(scene)
    port = PtyPort()
    with running_firmware(scene, port):
        yield port.name
