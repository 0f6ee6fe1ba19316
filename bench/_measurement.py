"""The measurements: time, true error and certified bound of each method on the same arrays, in one run."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..circuits import METHODS, Design, scan, scan_batch
from ..common import plots
from ..common.arrays import FloatArray
from ..common.config import LEAST_SI, MOST_SI
from ..errors import InputError, MissingExtra, SolverError
from ._peers import PEERS, reference
from .harness import column

TOLERANCES = (1e-3, 1e-6, 1e-9, 1e-12)
_ONCE = 5.0  # s beyond which a peer is not run again to find its best time
_BUDGET = 0.4  # s for the repetitions of one measurement; at least two are made


@dataclass(frozen=True)
class Row:
    """One method on one array."""

    size: int = field(metadata=column("cells", "{0} x {0}"))
    segment: float = field(metadata=column("ohm per segment", "{:g}"))
    """ohm"""
    method: str = field(metadata=column("method", "{}", width=18))
    seconds: float | None = field(metadata=column("ms", "{:.3g}", unit=1e-3))
    """per frame, best of several runs (streams: median); None where it did not run, see ``note``"""
    error: float | None = field(default=None, metadata=column("worst cell", "{:.1e}"))
    """worst over all cells, relative to that cell's own reading"""
    full_scale_error: float | None = field(default=None, metadata=column("full scale", "{:.1e}"))
    """worst over all cells, relative to the largest reading: what the bound bounds"""
    bound: float | None = field(default=None, metadata=column("bound", "{:.1e}"))
    """certified beforehand; only ohmskin's methods have one"""
    note: str = field(default="", metadata=column("", "{}"))


def board(size: int, segment: float) -> Design:
    """N x N, one resistance in ohm for every segment and lead, ideal amplifiers."""
    lines = dict.fromkeys(("row_segment", "column_segment", "row_lead", "column_lead"), segment)
    return Design.model_validate(
        {
            "array": {"rows": size, "columns": size} | lines,
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "inverting-amplifier", "reference_resistance": 1000.0},
        }
    )


def cells(size: int, seed: int = 0, frames: int = 1) -> FloatArray:
    """(frames, N, N) ohm from 10 kohm to 1 Mohm."""
    return 10 ** np.random.default_rng(seed).uniform(4.0, 6.0, (frames, size, size))


def measure(
    sizes: Sequence[int],
    segments: Sequence[float],
    *,
    peers: bool = True,
    patient: bool = False,
) -> Iterator[Row]:
    """Measure everything, row by row as it is done.

    Args:
        sizes: sides of the arrays.
        segments: ohm per segment and lead.
        peers: also measure other programs and libraries.
        patient: wait also for those that take far longer than the others.

    Raises:
        InputError: a size or a resistance that makes no array.

    """
    for size in sizes:
        if not 1 <= size <= 1024:
            raise InputError(f"size is {size}; expected 1 to 1024")
    for segment in segments:
        if not LEAST_SI <= segment <= MOST_SI:
            raise InputError(
                f"segment is {segment} ohm; expected {LEAST_SI:g} to {MOST_SI:g}: the peers need more than 0"
            )
    return _rows(sizes, segments, peers, patient)


def _rows(sizes: Sequence[int], segments: Sequence[float], peers: bool, patient: bool) -> Iterator[Row]:
    for size in sizes:
        for segment in segments:
            design, frame = board(size, segment), cells(size)[0]
            true = reference(design, frame)
            yield from _own(design, frame, true, segment)
            yield _batch(design, size, segment)
            if peers:
                yield from _others(design, frame, true, segment, patient)


def _own(design: Design, frame: FloatArray, true: FloatArray, segment: float) -> Iterator[Row]:
    size = len(frame)
    unit = -design.drive.voltage * np.max(design.readout.reference_resistance)
    for name, asked in [
        *((method, {"method": method}) for method in METHODS),
        *((f"tolerance {tolerance:g}", {"tolerance": tolerance}) for tolerance in TOLERANCES),
    ]:
        try:
            result = scan(design, frame, **asked)  # type: ignore[arg-type]  # one of two keywords
        except SolverError as error:
            yield Row(size, segment, name, None, note=str(error))
            continue
        seconds = _best(lambda asked=asked: scan(design, frame, **asked))  # type: ignore[misc]
        yield Row(
            size,
            segment,
            name,
            seconds,
            *_errors(result.volts / unit, true),
            bound=result.error_bound,
            note=f"by {result.method}" if name != result.method else "",
        )


def _batch(design: Design, size: int, segment: float) -> Row:
    count = max(2, min(200, 40000 // size**2))
    together = cells(size, 2, count)
    seconds = _best(lambda: scan_batch(design, together)) / count
    return Row(size, segment, "exact, in a batch", seconds, note=f"of {count} frames")


def _others(design: Design, frame: FloatArray, true: FloatArray, segment: float, patient: bool) -> Iterator[Row]:
    size = len(frame)
    for peer in PEERS:
        reason = peer.missing()
        if reason is None and size > peer.largest and not patient:
            reason = f"not waited for beyond {peer.largest} x {peer.largest} (--wait)"
        if reason is not None:
            yield Row(size, segment, peer.name, None, note=reason)
            continue
        start = time.perf_counter()
        try:
            currents = peer.solve(design, frame)
        except (SolverError, MissingExtra, ValueError, RuntimeError) as error:
            yield Row(size, segment, peer.name, None, note=f"failed: {error}")
            continue
        seconds = time.perf_counter() - start
        if seconds < _ONCE:
            seconds = _best(lambda peer=peer: peer.solve(design, frame))  # type: ignore[misc]  # bound now, called now
        yield Row(
            size,
            segment,
            peer.name,
            seconds,
            *_errors(currents, true),
            note="" if seconds < _ONCE else "once",
        )


def _errors(currents: FloatArray, true: FloatArray) -> tuple[float, float]:
    off = np.abs(currents - true)
    return float((off / true).max()), float(off.max() / true.max())


def _best(work: Callable[[], object]) -> float:
    """Seconds of the fastest of several runs."""
    gc.collect()
    best, spent, runs = np.inf, 0.0, 0
    while runs < 2 or (spent < _BUDGET and runs < 1000):
        start = time.perf_counter()
        work()
        took = time.perf_counter() - start
        best, spent, runs = min(best, took), spent + took, runs + 1
    return best


def picture(rows: Sequence[Row]) -> str:
    """SVG: error against time, one panel per segment resistance, one curve per method through the sizes.

    Raises:
        MissingExtra: matplotlib is not installed.

    """
    segments = list(dict.fromkeys(row.segment for row in rows))
    shown = sorted((row for row in rows if row.seconds and row.error is not None), key=lambda row: row.size)
    own = {row.method for row in shown if row.bound is not None}
    with plots.drawing(1, len(segments), width=1.9 + 4.6 * len(segments), height=3.6, sharey=True) as (figure, axes):
        for panel, segment in zip(axes[0], segments, strict=True):
            here = [row for row in shown if row.segment == segment]
            for method in dict.fromkeys(row.method for row in here):
                curve = [row for row in here if row.method == method]
                times = [1e3 * (row.seconds or 0.0) for row in curve]
                errors = [max(row.error or 0.0, 1e-17) for row in curve]
                line, width = ("o-", 1.4) if method in own else ("s--", 0.9)
                panel.plot(times, errors, line, ms=3.5, lw=width, label=method)
                for row, at, height in zip(curve, times, errors, strict=True):
                    panel.annotate(str(row.size), (at, height), textcoords="offset points", xytext=(3, 3), fontsize=6)
            panel.set(xscale="log", yscale="log", xlabel="time per frame / ms", title=f"{segment:g} ohm per segment")
        axes[0][0].set_ylabel("worst error of a reading, relative to it")
        figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
        return plots.svg(figure)
