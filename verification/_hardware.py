"""Quantities measured on a board (the firmware, or behind a port), beside what the simulation says of the same.

The board is untouched, or carries a jig of known resistors (``--jig CELLS.csv``). Readings are taken as counts and made
into resistances by the law of the ideal circuit, as the simulated quantities are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from ..circuits import clipped, volts_of_codes
from ..common.arrays import FloatArray
from ..driver import Frame, Skin
from ..emulator import BoardSettings, PtyPort, Scene, SkinSettings, running
from ..errors import LinkError, MissingExtra, ProtocolError
from ._dut import DesignUnderTest, once
from ._outcome import Measurement, NotRun
from ._units import engineering

FRAMES = 200
PATIENCE_S = 60.0
"""for one frame: a slow machine is no failure"""


@dataclass(frozen=True)
class Readings:
    """Frames of an unchanging skin."""

    volts: FloatArray
    """(frames, rows, columns)"""
    clipped: FloatArray
    """(frames, rows, columns) 1 where a code is the first or the last"""
    lost: int
    valid: float
    """share of the cells"""
    device_steps: FloatArray
    """(frames - 1,) s from frame to frame, by the board's clock; none of a board without one"""


def measured_on_board(
    dut: DesignUnderTest, quantity: str, measure: Callable[[DesignUnderTest, Readings], Measurement] | None
) -> Measurement:
    """One quantity of the catalogue, measured on the target of this run.

    Raises:
        NotRun: the quantity cannot be measured, there is no board, or no jig where the true resistances matter.
    """
    if dut.target == "emulated":
        raise NotRun("no board: --target names a port, or the firmware")
    if measure is None:
        raise NotRun(f"'{quantity}' cannot be measured on a board")
    dut.converter()
    readings = readings_of(dut)
    found = measure(dut, readings)
    source = f"{len(readings.volts)} frames of the board at {dut.target}"
    if found.resolution:
        source += f"; resolution {engineering(found.resolution, found.unit, 2)}"
    return replace(found, confidence=source)


def true_cells(dut: DesignUnderTest) -> FloatArray:
    """(rows, columns) ohm of what is on the board: the jig, or cells at rest."""
    return np.full(dut.design.array.shape, dut.rest) if dut.jig is None else dut.jig


@once
def readings_of(dut: DesignUnderTest) -> Readings:
    """What the board of this run sends. Raises NotRun where there is none, or another one."""
    try:
        with (
            _board(dut) as port,
            Skin.open(port, board=dut.board, baudrate=dut.baud, delivery="every", timeout=PATIENCE_S) as skin,
        ):
            if skin.shape != dut.design.array.shape:
                raise NotRun(f"the board has {skin.shape} cells, the design {dut.design.array.shape}")
            frames: list[Frame] = list(islice(skin, FRAMES))
    except (LinkError, ProtocolError, MissingExtra) as error:
        raise NotRun(f"no board: {error}") from error
    counts = np.array([frame.counts for frame in frames])
    return Readings(
        volts=volts_of_codes(dut.design, counts),
        clipped=clipped(dut.design, counts).astype(np.float64),
        lost=sum(frame.lost_before or 0 for frame in frames[1:]),
        valid=float(np.mean([frame.valid.mean() for frame in frames])),
        device_steps=np.diff([frame.device_time for frame in frames if frame.device_time is not None]),
    )


@contextmanager
def _board(dut: DesignUnderTest) -> Iterator[str]:
    """The name of a port with the target behind it."""
    if dut.target != "firmware":
        yield dut.target
        return
    rate = dut.design.operation.frame_rate or 50.0
    cell = dut.cell if dut.jig is None else dut.cell.replace(rest_resistance_ohm=float(dut.jig.mean()))
    if dut.jig is not None and (dut.jig != dut.jig.flat[0]).any():
        raise NotRun("an emulated board has cells of one resistance at rest; expected a jig of equal resistors")
    step = dut.design.adc.step if dut.design.adc else 0.0
    scene = Scene(skin=SkinSettings(design=dut.design, cell=cell), board=BoardSettings(frame_rate=rate, noise=step / 4))
    with PtyPort() as port, running(scene, port, engine="firmware"):
        yield port.name
