"""Pictures, in one style: of the report, of the bench, of a calibration."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import MissingExtra
from .extras import install_command

# Okabe and Ito's palette: told apart by colour-blind readers and in grey print.
INK, BLUE, ORANGE, GREEN, RED, SKY, PURPLE = "#1d2430", "#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7"
_MORE = "#7f7f7f", "#8c564b", "#9a9a00", "#332288"  # for pictures with many curves

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
    """A matplotlib figure and its axes (rows, columns), in the project's style until the block ends.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from cycler import cycler
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra(f"plots need matplotlib: {install_command('report')}") from error
    colours = cycler(color=[BLUE, ORANGE, GREEN, RED, SKY, PURPLE, *_MORE])
    with mpl.rc_context():
        mpl.rcdefaults()  # a matplotlibrc in the working folder may be anybody's, and start LaTeX
        mpl.rcParams.update(STYLE | {"axes.prop_cycle": colours})
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, figure.subplots(rows, columns, squeeze=False, **subplots)


def svg(figure: Any) -> str:
    """The figure as an SVG element that can stand in HTML; call it inside :func:`drawing`."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
