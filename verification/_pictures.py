"""Pictures of the report: curves, pressures as applied and estimated, and arrays of cells."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ..common import plots
from ..common.arrays import BoolArray, FloatArray, IntArray
from ._outcome import Figure, drawn

NUMBERED_CELL_IN, CELL_IN = 0.42, 0.2
"""side of a cell of a :func:`value_map`, with room for a number or without"""
LARGEST_MAP_IN = 3.6
"""longer side of a map: two fit on a printed page, with their text"""


def picture(
    caption: str, draw: Callable[[Any], object], rows: int = 1, columns: int = 1, *, height: float = 2.7, **size: Any
) -> list[Figure]:
    """What a function draws into panels (rows, columns), in inches; none without matplotlib."""

    def made() -> Figure:
        with plots.drawing(rows, columns, height=height, **size) as (figure, panels):
            draw(panels)
            return Figure(plots.svg(figure), caption)

    return drawn(made)


def curves(panel: Any, x: FloatArray, lines: Mapping[str, FloatArray], **settings: Any) -> None:
    """Curves over one abscissa with their legend; ``settings`` are titles, labels and limits of the axes."""
    for label, y in lines.items():
        panel.plot(x, y, lw=1.2, label=label)
    panel.set(**settings)
    panel.legend()


def pressures(panel: Any, time_s: FloatArray, applied: FloatArray, estimated: Mapping[str, FloatArray]) -> None:
    """Applied and estimated pressure of one cell."""
    panel.plot(time_s, applied, color=plots.INK, lw=4, alpha=0.25, label="applied")
    curves(panel, time_s, estimated, xlabel="time / s", ylabel="pressure / kPa")


def histories(
    caption: str,
    time_s: FloatArray,
    applied: FloatArray,
    estimated: FloatArray,
    places: Iterable[tuple[int, int]],
    label: str,
    **settings: Any,
) -> list[Figure]:
    """Pressures (frames, rows, columns) of some cells, one above the other."""
    chosen = list(places)

    def draw(panels: Any) -> None:
        for panel, (row, column) in zip(panels[:, 0], chosen, strict=True):
            pressures(panel, time_s, applied[:, row, column], {label: estimated[:, row, column]})
            panel.set(title=f"cell ({row}, {column})", xlabel="", ylabel="kPa", **settings)
            panel.get_legend().remove()
        panels[0, 0].legend(ncols=2, loc="upper right")
        panels[-1, 0].set_xlabel("board time / s")

    return picture(caption, draw, len(chosen), height=0.9 + 1.25 * len(chosen), sharex=True)


def heat_maps(
    maps: Mapping[str, FloatArray],
    *,
    label: str,
    limit: float,
    marked: BoolArray | None = None,
    values: str = "{:.1f}",
    size: float = 1.75,
) -> str:
    """Arrays (rows, columns) side by side on one diverging scale from -limit to +limit; ``marked`` cells outlined.

    Cells are drawn as they are, without interpolation, and small arrays carry their numbers.
    """
    rows, columns = next(iter(maps.values())).shape
    width, height = size * len(maps) + 0.7, size * min(max(rows / columns, 0.4), 2) + 0.6
    with plots.drawing(1, len(maps), width=width, height=height) as (figure, axes):
        for panel, (title, array) in zip(axes[0], maps.items(), strict=True):
            image = panel.imshow(array, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
            panel.set_title(title.replace(", ", ",\n"), fontsize=8.5)
            shown = values if rows * columns <= 36 else ""
            _label(panel, array, np.abs(array) > 0.55 * limit, shown, most_ticks=8)
            _outline(panel, np.zeros((0, 2)) if marked is None else np.argwhere(marked))
        figure.colorbar(image, ax=axes[0].tolist(), shrink=0.85, label=label)
        return plots.svg(figure)


def value_map(array: FloatArray, *, label: str, top: float, limit: float | None) -> str:
    """One array (rows, columns) of magnitudes from 0 to ``top``, the limit marked on the scale; NaN stays empty.

    Where every cell is beyond the limit, the scale begins at the least value, and no cell is outlined.
    """
    rows, columns = array.shape
    numbered = rows * columns <= 64
    side = min(NUMBERED_CELL_IN if numbered else CELL_IN, LARGEST_MAP_IN / max(rows, columns))
    width, height = max(3.2, side * columns + 1.6), max(2.0, side * rows + 0.6)
    known = array[np.isfinite(array)]
    all_beyond = limit is not None and known.size > 0 and float(known.min()) > limit
    bottom = float(known.min()) if all_beyond and float(known.min()) < top else 0.0
    with plots.drawing(1, 1, width=width, height=height) as (figure, ((panel,),)):
        image = panel.imshow(array, cmap="viridis_r", vmin=bottom, vmax=top, interpolation="nearest")
        panel.set(xlabel="column", ylabel="row")
        _label(panel, array, array - bottom > 0.6 * (top - bottom), "{:.2f}" if numbered else "", most_ticks=16)
        bar = figure.colorbar(image, ax=panel, shrink=0.9, label=label)
        if all_beyond:
            panel.set_title("every cell is beyond the limit", fontsize=8.5, color=plots.RED)
        elif limit is not None:
            bar.ax.axhline(limit, color=plots.RED, lw=2)
            bar.ax.text(-0.15, limit, "limit ", color=plots.RED, ha="right", va="center", fontsize=8)
            _outline(panel, np.argwhere(np.nan_to_num(array, nan=0.0) > limit), plots.RED)
        return plots.svg(figure)


def _label(panel: Any, array: FloatArray, dark: BoolArray, values: str, *, most_ticks: int) -> None:
    """Ticks at cells (rows, columns), and the finite values as text in the form ``values``, white on ``dark`` cells."""
    rows, columns = array.shape
    panel.grid(visible=False)
    panel.set_xticks(range(columns) if columns <= most_ticks else [0, columns - 1])
    panel.set_yticks(range(rows) if rows <= most_ticks else [0, rows - 1])
    panel.tick_params(length=0)
    style = {"ha": "center", "va": "center", "fontsize": 7, "in_layout": False}
    for i, j in np.argwhere(np.isfinite(array)) if values else ():
        panel.text(j, i, values.format(array[i, j]), color="w" if dark[i, j] else plots.INK, **style)


def _outline(panel: Any, places: FloatArray | IntArray, colour: str = plots.INK) -> None:
    """Frames around cells (K, 2)."""
    from matplotlib.patches import Rectangle

    for row, column in places:
        corner = column - 0.5, row - 0.5
        panel.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor=colour, linewidth=1.8))
