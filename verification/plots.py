"""Pictures of the report: one style, SVG text out."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtra

FloatArray = NDArray[np.float64]

# Okabe and Ito's palette: told apart by colour-blind readers and in grey print.
INK, BLUE, ORANGE, GREEN, RED, SKY, PURPLE = "#1d2430", "#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7"

STYLE = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#6b7280",
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": "#4b5563",
    "ytick.color": "#4b5563",
    "axes.grid": True,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "none",
    "svg.fonttype": "path",
    "svg.hashsalt": "ohmskin",  # the same picture gives the same bytes
}


@contextmanager
def drawing(
    rows: int = 1, columns: int = 1, *, width: float = 8.4, height: float = 2.9, **subplots: Any
) -> Iterator[tuple[Any, Any]]:
    """A matplotlib figure and its axes (rows, columns), in the report's style until the block ends.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from cycler import cycler
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("plots need matplotlib: pip install 'ohmskin[report]'") from error
    colours = cycler(color=[BLUE, ORANGE, GREEN, RED, SKY, PURPLE])
    with mpl.rc_context(STYLE | {"axes.prop_cycle": colours}):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, figure.subplots(rows, columns, squeeze=False, **subplots)


def svg(figure: Any) -> str:
    """The figure as an SVG element that can stand in HTML; call it inside :func:`drawing`."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def heat_maps(
    maps: Mapping[str, FloatArray],
    *,
    label: str,
    limit: float,
    marked: NDArray[np.bool_] | None = None,
    values: str = "{:.1f}",
    size: float = 1.75,
) -> str:
    """Arrays (rows, columns) side by side on one diverging scale from -limit to +limit; ``marked`` cells outlined.

    Cells are drawn as they are, without interpolation, and small arrays carry their numbers.
    """
    rows, columns = next(iter(maps.values())).shape
    width, height = size * len(maps) + 0.7, size * min(max(rows / columns, 0.4), 2) + 0.6
    with drawing(1, len(maps), width=width, height=height) as (figure, axes):
        for panel, (title, array) in zip(axes[0], maps.items(), strict=True):
            image = panel.imshow(array, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
            panel.set_title(title.replace(", ", ",\n"), fontsize=8.5)
            panel.grid(visible=False)
            panel.set_xticks(range(columns) if columns <= 8 else [0, columns - 1])
            panel.set_yticks(range(rows) if rows <= 8 else [0, rows - 1])
            panel.tick_params(length=0)
            if rows * columns <= 36:
                for (i, j), value in np.ndenumerate(array):
                    colour = "w" if abs(value) > 0.55 * limit else INK
                    panel.text(j, i, values.format(value), ha="center", va="center", fontsize=7, color=colour)
            if marked is not None:
                for i, j in np.argwhere(marked):
                    panel.add_patch(_outline(j, i))
        figure.colorbar(image, ax=axes[0].tolist(), shrink=0.85, label=label)
        return svg(figure)


def _outline(column: int, row: int) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=INK, linewidth=1.8)
