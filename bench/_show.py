"""Measurements as a table and as a picture."""

from __future__ import annotations

from collections.abc import Sequence

from ..common import plots
from ._measurement import Row

_COLUMNS = ("method", "time", "worst cell", "full scale", "bound", "memory", "")


def table(rows: Sequence[Row]) -> str:
    """One block of lines per array."""
    blocks = []
    for size, segment in dict.fromkeys((row.size, row.segment) for row in rows):
        some = [row for row in rows if (row.size, row.segment) == (size, segment)]
        lines = [_COLUMNS, *map(_line, some)]
        widths = [max(len(line[k]) for line in lines) for k in range(len(_COLUMNS))]
        text = "\n".join(
            "  ".join(f"{part:<{width}}" for part, width in zip(line, widths, strict=True)).rstrip() for line in lines
        )
        blocks.append(f"{size} x {size}, {segment:g} ohm per segment\n{text}\n")
    return "\n".join(blocks)


def _line(row: Row) -> tuple[str, ...]:
    def number(value: float | None) -> str:
        return "" if value is None else f"{value:.1e}"

    memory = "" if row.memory is None else f"{row.memory / 1e6:.0f} MB"
    time = "-" if row.seconds is None else _duration(row.seconds)
    return row.method, time, number(row.error), number(row.full_scale_error), number(row.bound), memory, row.note


def _duration(seconds: float) -> str:
    if seconds >= 1.0:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} us"


def picture(rows: Sequence[Row]) -> str:
    """SVG: error against time, one panel per segment resistance, one curve per method through the sizes.

    Raises:
        MissingExtra: matplotlib is not installed.

    """
    segments = list(dict.fromkeys(row.segment for row in rows))
    shown = [row for row in rows if row.seconds and row.error is not None]
    with plots.drawing(1, len(segments), width=1.9 + 4.6 * len(segments), height=3.6, sharey=True) as (figure, axes):
        panels = axes[0]
        for panel, segment in zip(panels, segments, strict=True):
            for method in dict.fromkeys(row.method for row in shown):
                curve = sorted(
                    (row for row in shown if row.method == method and row.segment == segment), key=lambda row: row.size
                )
                times, errors = (
                    [1e3 * (row.seconds or 0.0) for row in curve],
                    [max(row.error or 0.0, 1e-17) for row in curve],
                )
                own = any(row.bound is not None for row in curve)
                panel.plot(times, errors, "o-" if own else "s--", ms=3.5, lw=1.4 if own else 0.9, label=method)
                for row, x, y in zip(curve, times, errors, strict=True):
                    panel.annotate(str(row.size), (x, y), textcoords="offset points", xytext=(3, 3), fontsize=6)
            panel.set(xscale="log", yscale="log", xlabel="time per frame / ms", title=f"{segment:g} ohm per segment")
        panels[0].set_ylabel("worst error of a reading, relative to it")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
        return plots.svg(figure)
