"""Measurements on the firmware in the loop: settling error against dwell, frame rates against ADC and line speed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...circuits import Design, Settling, scan
from ...common.arrays import FloatArray
from ...wire import Flag, FramePacket, Order, PacketDecoder, Reply, Status, host_protocol
from .._scene import Scene
from .._skin import Sample
from ._board import BoardSettings, FirmwareBoard

PRESCALERS_LOG2 = (7, 6, 5, 4)
"""prescalers of the ADC, 2**this"""
BAUD_RATES = (115_200, 500_000, 1_000_000, 2_000_000)
ERROR_BUDGET_STEPS = 0.5
"""ADC steps by which a reading may be off because it has not settled"""
_SLICE_S = 5e-3
"""s of board time between two looks at what the board has sent"""
_AFTER_INTRODUCTION_S = 0.5
"""s of board time after which the board has described itself, at any line speed but the slowest"""
_COUNTED_S = 0.5
_PREDICTED_ACQUISITION = 2e-6
"""s given to the predicted capacitor: Settling has all conversions of a row follow each other at its end"""


@dataclass(frozen=True, slots=True)
class DwellError:
    """How far readings are from settled at one dwell. Errors in ADC steps, the largest of the frame."""

    dwell_us: int
    """us from selecting a row to its first conversion, as set"""
    measured_steps: float
    predicted_steps: float
    """by :class:`ohmskin.circuits.Settling` for the same instants"""


@dataclass(frozen=True, slots=True)
class FrameRate:
    """The fastest scan at one ADC clock that keeps the error budget."""

    adc_clock_hz: float
    dwell_us: int
    error_steps: float
    frames_per_s: float


def harsh_cells(design: Design) -> FloatArray:
    """(rows, columns) ohm: rows at 10 kohm between rows without cells, so that every output jumps at every step."""
    cells = np.full(design.array.shape, 10e3)
    cells[1::2] = np.inf
    return cells


def dwell_error(design: Design, settings: BoardSettings) -> DwellError:
    """Run the firmware over cells that are hard to settle, and compare with the model for its sample instants.

    Args:
        design: of a board that there is a firmware for.
        settings: with the dwell.

    Raises:
        MissingExtra: the emulated processor is not installed.

    """
    cells = harsh_cells(design)
    samples: list[Sample] = []
    with FirmwareBoard(_scene(design), settings=settings, record=samples.append) as board:
        board.hold_cells(cells)
        while not samples:
            board.run(_SLICE_S)
        selected = {row: time for time, row in board.row_switches}
        instants = [(time - selected[row], row, column) for time, row, column in board.sample_instants]
        dwell_us = board.settings.dwell_us if board.settings.dwell_us is not None else board.kind.dwell_us
    assert design.adc is not None
    settling = Settling(design.replace(adc={"acquisition_time": _PREDICTED_ACQUISITION}), cells)
    settled = scan(design, cells, method="exact").volts
    predicted = np.zeros(cells.shape)
    columns = design.array.columns
    for after, row, column in instants:
        if row % 2 == 0:
            period = after + (columns - 1 - column) * _PREDICTED_ACQUISITION
            predicted[row, column] = settling.sampled_from_rest(period)[row, column] - settled[row, column]
    loaded = slice(None, None, 2)
    return DwellError(
        dwell_us,
        float(np.abs(samples[-1].volts - settled)[loaded].max() / design.adc.step),
        float(np.abs(predicted).max() / design.adc.step),
    )


def fastest_scan(design: Design, prescaler_log2: int, baud: int = 1_000_000) -> FrameRate:
    """The shortest dwell that keeps :data:`ERROR_BUDGET_STEPS`, and the frame rate that the firmware takes with it."""
    low, high = 0, 1024
    settings = BoardSettings(adc_prescaler_log2=prescaler_log2, baud=baud, period_us=200_000)

    def error(dwell_us: int) -> float:
        return dwell_error(design, replace(settings, dwell_us=dwell_us)).measured_steps

    if error(low) <= ERROR_BUDGET_STEPS:
        high = low
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if error(middle) <= ERROR_BUDGET_STEPS else (middle, high)
    period_us = shortest_period_us(design, replace(settings, dwell_us=high))
    return FrameRate(16e6 / 2**prescaler_log2, high, error(high), 1e6 / period_us)


def shortest_period_us(design: Design, settings: BoardSettings) -> int:
    """The shortest time between two frames, in us, that the firmware takes."""
    with FirmwareBoard(_scene(design), settings=settings) as board:
        host = host_protocol("ohmskin")
        board.run(_SLICE_S)
        board.send(host.request(Order.STOP))

        def takes(period_us: int) -> bool:
            board.send(host.request(Order.RATE, period_us=period_us))
            while True:
                for event in host.feed(board.run(_SLICE_S), board.time_s):
                    if isinstance(event, Reply) and event.order == Order.RATE.value:
                        return event.status is Status.TAKEN

        low, high = 1, 200_000
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if takes(middle) else (middle, high)
    return high


def line_rate(design: Design, baud: int) -> tuple[float, float]:
    """Frames per second that arrive, and that the board drops, at its shortest period and the usual dwell."""
    usual = BoardSettings(baud=baud, period_us=200_000)
    period_us = shortest_period_us(design, usual)
    settings = BoardSettings(baud=baud, period_us=period_us)
    with FirmwareBoard(_scene(design), settings=settings) as board:
        decoder = PacketDecoder()
        decoder.feed(board.run(_AFTER_INTRODUCTION_S))
        frames = [event for event in decoder.feed(board.run(_COUNTED_S)) if isinstance(event, FramePacket)]
    first, last = frames[0], frames[-1]
    assert first.time_us is not None
    assert last.time_us is not None
    assert first.sequence is not None
    assert last.sequence is not None
    seconds = (last.time_us - first.time_us) / 1e6
    dropped = last.sequence - first.sequence - (len(frames) - 1)
    assert dropped == 0 or any(Flag.OVERRUN in frame.flags for frame in frames)
    return (len(frames) - 1) / seconds, dropped / seconds


def _scene(design: Design) -> Scene:
    return Scene.model_validate({"skin": {"design": design}})
