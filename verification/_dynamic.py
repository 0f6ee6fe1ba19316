"""Quantities in time: settling, fastest scan, stability, noise, and what noise means in pressure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from ..circuits import (
    Boards,
    Design,
    Noise,
    Requirement,
    Settling,
    apparent_resistance,
    noise,
    scan_population,
    stability,
)
from ..common import plots
from ..common.arrays import FloatArray
from ..errors import InputError, SolverError
from ..wire import FramePacket, encode
from ._outcome import DoesNotApply, Figure, Measurement, NotRun
from ._subject import Subject
from ._units import engineering

BITS_PER_BYTE = 10
"""a start bit, eight data bits, a stop bit"""
DYNAMIC_PARTS = ("gain_bandwidth", "column_capacitance", "feedback_capacitance", "reference_resistance")
"""Parts whose tolerances are taken at all combinations of their ends, the same on every column."""


def missing(design: Design, keys: tuple[str, ...]) -> list[str]:
    """Those of the keys ("readout.gain_bandwidth") that the design leaves at their ideal value."""
    absent = []
    for key in keys:
        section, name = key.split(".")
        part = getattr(design, section)
        if part is None or np.all(np.asarray(getattr(part, name)) == _default(part, name)):
            absent.append(key)
    return absent


def _default(part: Any, name: str) -> Any:
    default = type(part).model_fields[name].default
    return np.nan if default is None else default


def _need(design: Design, *keys: str) -> None:
    absent = missing(design, keys)
    if absent:
        raise NotRun(f"missing: {', '.join(absent)}")


SETTLING_PARTS = ("readout.gain_bandwidth", "readout.column_capacitance")
PASSIVE_SETTLING_PARTS = ("readout.column_capacitance",)
"""of a divider"""
NOISE_PARTS = ("readout.voltage_noise", "readout.temperature", "readout.gain_bandwidth")
"""of an amplifier that holds its line"""
PASSIVE_NOISE_PARTS = ("readout.temperature", "adc.sampling_capacitance")
"""of a divider"""


def missing_dynamics(design: Design) -> list[str]:
    """Keys that noise and settling of the design's readings need, and that it leaves at their ideal value."""
    circuit = design.board.circuit
    if circuit.virtual_ground:
        return missing(design, tuple(dict.fromkeys((*NOISE_PARTS, *SETTLING_PARTS))))
    return [] if circuit.has_amplifiers else missing(design, (*PASSIVE_NOISE_PARTS, *PASSIVE_SETTLING_PARTS))


def _amplifiers_only(design: Design, quantity: str) -> None:
    if not design.board.circuit.virtual_ground:
        modelled = "amplifiers that hold all sensed lines"
        raise NotRun(f'{quantity} is modelled for {modelled}, not for "{design.readout.circuit}"')


def rate_of(subject: Subject, requirement: Requirement | None = None) -> float:
    """The frame rate in Hz that is asked for. Raises NotRun where none is stated."""
    stated = requirement.conditions.frame_rate if requirement is not None else None
    rate = stated or subject.design.operation.frame_rate
    if rate is None:
        raise NotRun("missing: operation.frame_rate")
    return rate


def dynamic_corners(subject: Subject) -> list[tuple[str, Design]]:
    """The nominal design, and every combination of the ends of the tolerances of :data:`DYNAMIC_PARTS`."""
    design, spreads = subject.design, subject.design.spreads
    ends: dict[str, tuple[float, float]] = {}
    for name in DYNAMIC_PARTS:
        spread = spreads.get(f"readout.{name}")
        value = np.asarray(getattr(design.readout, name), dtype=np.float64)
        if spread is None or not np.isfinite(value).all() or not (spread.tolerance or spread.deviation):
            continue
        width = float(spread.tolerance + spread.deviation / max(float(value.max()), 1e-300))
        ends[name] = (1 - width, 1 + width)
    corners = [("nominal parts", design)]
    for factors in product(*ends.values()):
        if not factors:
            break
        changed = {
            name: _times(factor, getattr(design.readout, name)) for name, factor in zip(ends, factors, strict=True)
        }
        label = ", ".join(f"{name} {'low' if f < 1 else 'high'}" for name, f in zip(ends, factors, strict=True))
        corners.append((label, design.replace(readout=changed)))
    return corners


def _times(factor: float, value: float | tuple[float, ...]) -> float | tuple[float, ...]:
    return tuple(factor * part for part in value) if isinstance(value, tuple) else factor * value


def frames_of(subject: Subject) -> Iterator[tuple[str, FloatArray]]:
    """Frames that are hard in time: every row switch is a jump for every column, or the cells load the amplifiers."""
    low, high = subject.extremes
    board = subject.design.board
    for first in (0, 1) if board.shape[0] > 1 else (0,):
        cells = np.full(board.shape, low)
        cells[first::2] = high
        span = f"{engineering(low, 'ohm')} and {engineering(high, 'ohm')}"
        yield f"{board.line_kinds[0]}s alternate between {span}", board.turn(cells)
    if not board.circuit.has_amplifiers and board.shape[0] > 2:
        # Columns without amplifiers are slowest where few cells conduct.
        cells = np.full(board.shape, high)
        cells[0] = low
        others = f"all others at {engineering(high, 'ohm')}"
        yield f"{board.line_kinds[0]} 0 at {engineering(low, 'ohm')}, {others}", board.turn(cells)
    for ohms in (low, high):
        yield f"all cells at {engineering(ohms, 'ohm')}", np.full(subject.design.array.shape, ohms)


def _settlings(subject: Subject) -> list[tuple[str, Settling]]:
    design = subject.design
    if design.board.circuit.has_amplifiers:
        _amplifiers_only(design, "settling")
        _need(design, *SETTLING_PARTS)
    else:
        _need(design, *PASSIVE_SETTLING_PARTS)
    if "settling" not in subject.memo:
        try:
            subject.memo["settling"] = [
                (f"{state}; {corner}", Settling(variant, cells))
                for corner, variant in dynamic_corners(subject)
                for state, cells in frames_of(subject)
            ]
        except SolverError as error:
            raise NotRun(f"settling is linear: {error}") from error
    found: list[tuple[str, Settling]] = subject.memo["settling"]
    return found


def settling_error(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest deviation of a sampled reading from the settled one at the declared rate, % of the largest signal."""
    found = largest_settling_error(subject, requirement)
    if not np.isfinite(found.value):
        return found
    period = 1.0 / (rate_of(subject, requirement) * subject.design.board.shape[0])
    return replace(found, figures=[_settling_figure(subject, _settlings(subject)[0][1], period)])


def largest_settling_error(subject: Subject, requirement: Requirement) -> Measurement:
    """As :func:`settling_error`, without its figure."""
    rate = rate_of(subject, requirement)
    settlings = _settlings(subject)
    period = 1.0 / (rate * subject.design.board.shape[0])
    largest = max(settling.signal for _, settling in settlings)
    try:
        errors = [(100 * settling.error(period) * settling.signal / largest, where) for where, settling in settlings]
    except InputError as error:
        return Measurement(np.inf, "%", where=f"row period {engineering(period, 's')}: {error}")
    worst, where = max(errors)
    return Measurement(
        float(worst),
        "%",
        where=where,
        confidence=f"{len(errors)} combinations of frames and ends of tolerances",
        text=[
            f"At {engineering(rate, 'Hz')} each {subject.design.board.line_kinds[0]} has {engineering(period, 's')}."
        ],
    )


def _settling_figure(subject: Subject, settling: Settling, period: float) -> Figure:
    adc, columns = subject.design.adc, subject.design.board.shape[1]
    half_way = 0.5 * settling.shortest_period(0.5)
    shortest = max(min(half_way, period / 2), (adc.acquisition_time * columns) if adc else 0.0)
    periods = np.geomspace(max(shortest, 1e-9), 2 * period, 60)
    signal = float(np.abs(settling.settled - subject.design.readout.reference_voltage).max())
    with plots.drawing(1, 1, height=2.6) as (figure, ((panel,),)):
        panel.loglog(1e6 * periods, [100 * max(settling.error(p), 1e-12) for p in periods])
        panel.axvline(1e6 * period, color=plots.INK, lw=1, ls=":")
        panel.text(1e6 * period, panel.get_ylim()[1], " declared", va="top", fontsize=8)
        if adc:
            panel.axhline(100 * adc.step / 4 / signal, color=plots.RED, lw=1, ls="--")
        panel.set(title="Settling", xlabel="row period / µs", ylabel="error / % of largest signal")
        return Figure(plots.svg(figure), "Error at the sample instant. Dashed: a quarter of an ADC step.")


def fastest_scan(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Frames per second at which every reading still settles to a quarter of an ADC step, Hz."""
    design = subject.design
    if design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    if requirement.min is None and requirement.max is None:
        raise NotRun("no limit is given; missing: operation.frame_rate")
    rates = []
    try:
        for where, settling in _settlings(subject):
            signal = float(np.abs(settling.settled - design.readout.reference_voltage).max())
            period = settling.shortest_period(min(design.adc.step / 4 / signal, 0.5))
            rates.append((1 / (period * design.board.shape[0]) if period > 0 else np.inf, where))
    except SolverError as error:
        return Measurement(0.0, "Hz", where=str(error))
    slowest, where = min(rates)
    if np.isinf(slowest):
        raise NotRun("missing: readout.gain_bandwidth or adc.sampling_capacitance: nothing limits the scan")
    return Measurement(float(slowest), "Hz", where=where, confidence=f"{len(rates)} frames and ends of tolerances")


def phase_margin(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Smallest phase margin of an amplifier on its column, degrees."""
    design = subject.design
    if not design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{design.readout.circuit}' has no feedback loop")
    _amplifiers_only(design, "stability")
    if not design.board.virtual_grounds:
        raise NotRun('stability is modelled for an amplifier on each line, not for readout.columns = "multiplexed"')
    _need(design, "readout.gain_bandwidth", "readout.column_capacitance")
    margins = []
    for corner, variant in dynamic_corners(subject):
        for state, cells in frames_of(subject):
            margin = stability(variant, cells).phase_margin
            if np.isfinite(margin).any():
                by_line = np.where(np.isnan(margin), np.inf, margin).min(axis=1 if design.board.turned else 0)
                line = int(np.argmin(by_line))
                kind = design.board.line_kinds[1]
                margins.append((float(np.nanmin(margin)), f"{kind} {line}; {state}; {corner}"))
    if not margins:
        raise NotRun("the loop gain is below 1 throughout: there is no crossover")
    least, where = min(margins)
    return Measurement(least, "°", where=where, confidence="amplifier of one pole; further poles take some of it away")


def noise_of(subject: Subject) -> list[tuple[str, FloatArray, Noise]]:
    """Noise of the readings with all cells at rest, and with all pressed."""
    design = subject.design
    if design.board.circuit.has_amplifiers:
        _amplifiers_only(design, "noise")
        _need(design, *NOISE_PARTS)
    else:
        _need(design, *PASSIVE_NOISE_PARTS)
    if "noise" not in subject.memo:
        states = (("at rest", subject.rest), ("at full scale", subject.pressed))
        try:
            subject.memo["noise"] = [
                (state, cells, noise(design, cells))
                for state, ohms in states
                for cells in [np.full(design.array.shape, ohms)]
            ]
        except InputError as error:
            raise NotRun(str(error)) from error
    found: list[tuple[str, FloatArray, Noise]] = subject.memo["noise"]
    return found


def reading_noise(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Standard deviation of one reading, quantisation included, V."""
    worst, where, parts = 0.0, "", {}
    for state, _, found in noise_of(subject):
        place = np.unravel_index(np.argmax(found.volts), found.shape)
        if found.volts[place] > worst:
            worst, where = float(found.volts[place]), f"cell {tuple(map(int, place))}, {state}"
            parts = {name: float(part[place]) for name, part in found.parts.items()}
    return Measurement(worst, "V", where=where, confidence="Lyapunov equation of the readout", contributions=parts)


def pressure_resolution(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Standard deviation of the pressure that one settled reading stands for, at the least favourable load, kPa."""
    if not subject.knows_pressure:
        raise NotRun("missing: cells.full_scale_kpa")
    worst, where = 0.0, ""
    full = subject.full_scale_kpa
    for (state, cells, found), load in zip(noise_of(subject), (0.01, 0.99), strict=True):
        near = np.array([0.99 * load, load])  # shares of full scale
        light, heavy = subject.cell.equilibrium_ohm(near)
        ohms_per_kpa = abs(float(heavy - light)) / (0.01 * load * full)
        volts_per_ohm = _volts_per_ohm(subject.design, cells)
        with np.errstate(divide="ignore"):  # a curve that is flat there tells no pressure
            kpa = found.volts / (volts_per_ohm * ohms_per_kpa)
        place = np.unravel_index(np.argmax(kpa), kpa.shape)
        if not kpa[place] <= worst:
            worst, where = float(kpa[place]), f"cell {tuple(map(int, place))}, {state}"
    return Measurement(worst, "kPa", where=where, confidence="one standard deviation of one reading")


def _volts_per_ohm(design: Design, cells: FloatArray) -> FloatArray:
    """|dV/dR| (N, M) of the ideal circuit at the reading of each cell."""
    volts = scan_population(design, Boards.of(design), cells[None]).volts[0]
    small = 1e-6 * max(float(np.abs(volts - design.readout.reference_voltage).max()), 1e-12)
    change = apparent_resistance(design, volts + small) - apparent_resistance(design, volts - small)
    slope: FloatArray = 2 * small / np.abs(change)
    return slope


def settling_share(subject: Subject, rate: float) -> float:
    """Share of the preceding row's reading that is left in a reading at the declared frame rate; 0 where not known."""
    try:
        settlings = _settlings(subject)
    except NotRun:
        return 0.0
    _, settling = settlings[0]
    try:
        sampled = settling.sampled(1.0 / (rate * subject.design.board.shape[0]))
    except InputError:
        return 1.0
    jump = np.abs(np.roll(settling.settled, 1, axis=1 if subject.design.board.turned else 0) - settling.settled)
    return float(min(np.abs(sampled - settling.settled).max() / max(float(jump.max()), 1e-300), 1.0))


def _frame_seconds(subject: Subject) -> tuple[float, int]:
    """s that one frame occupies the line, and its bytes."""
    baudrate = subject.design.operation.baudrate
    if baudrate is None:
        raise NotRun("missing: operation.baudrate")
    counts = np.full(subject.design.array.shape, 0x0101, dtype=np.uint16)
    length = len(encode(FramePacket.of(counts, sequence=1, time_us=1)))
    return length * BITS_PER_BYTE / baudrate, length


def latency(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """From a press to the frame that shows it at the host: a whole scan, and the transfer, s."""
    period = 1.0 / rate_of(subject, requirement)
    transfer, length = _frame_seconds(subject)
    if transfer > period:
        return Measurement(np.inf, "s", where=f"a frame of {length} bytes takes {engineering(transfer, 's')} to send")
    return Measurement(
        2 * period + transfer,
        "s",
        where="a press just after its cell was read",
        confidence="upper bound without the operating system's own delays",
        text=[f"Up to one frame until the cell is read again, one for its scan, {engineering(transfer, 's')} to send."],
    )


def lost_frames(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Share of frames that the line cannot carry, %."""
    rate = rate_of(subject, requirement)
    transfer, length = _frame_seconds(subject)
    carried = min(1.0 / transfer, rate)
    return Measurement(
        100 * (1.0 - carried / rate),
        "%",
        where=f"{length} bytes per frame: the line carries {engineering(1.0 / transfer, 'Hz')}",
        confidence="from the packet's length and the bit rate; an undisturbed line",
    )
