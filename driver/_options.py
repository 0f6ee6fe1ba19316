"""Options of a skin: the caller's settings, with files read and numbers checked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

from ..cell import ESTIMATORS, Cell
from ..circuits import Design, Shape, ValidityRule
from ..common.checks import count, loaded, number, of_kind, positive
from ..errors import InputError
from ..wire import Family, board_family
from ._calibration import Calibration
from ._frames import Delivery
from ._replay import NOTHING_RECORDED, RecordedSettings
from ._tuning import QUEUE

NATIVE = "ohmskin"
"""the family that is meant where none is named"""


class SkinSettings(TypedDict, total=False):
    """Settings of a skin, for :class:`.Skin` and :meth:`.Skin.open`; each has a default."""

    board: str | Path | Family
    """family of the board: a name (one of ``ohmskin.wire.BOARDS``, or of an installed package), an object, or the
    BOARD.toml that describes the board; for a recording only where the recorded one is not known"""
    design: Design | str | Path | None
    """the readout circuit, as an object or as a DESIGN.toml file; None: the design that the board describes, else the
    usual one of its family, else that which BOARD.toml names. Without any frames have counts only: ``resistance`` and
    ``pressure`` are NaN, and a tare takes the counts at rest"""
    cell: Cell | str | Path | None
    """the model of the skin's material, as an object or as a CELL.toml file; None: the model that the board describes.
    Without either, pressures are NaN"""
    estimator: str | None
    """name for :meth:`ohmskin.cell.Cell.estimator`"""
    timeout: float
    """limit in s (3) for each of three things: the wait for the board to identify itself; the processor time to set up
    the inverse of its circuit (at most ten times as long on a busy machine); later the wait for each frame. The
    compiler may take longer, once on a machine"""
    delivery: Delivery | None
    """which frames readers get, see :data:`Delivery`; None: ``newest``, and ``lossless`` for a recording and for an
    emulated board that runs as fast as it is read (``ohmskin://SCENE.toml?clock=fast``)"""
    queue: int
    """number of frames that wait for readers (256), unless ``delivery`` is ``newest``"""
    reconnect: float
    """s for which the driver tries to open a lost port again (10)"""
    pitch: float | tuple[float, float] | None
    """distance of neighbouring cells in m, for contacts; for cells that are not square (x, y), along a row and along a
    column. None: the pitch in the design's ``[sheet]``"""
    shape: Shape | str | Path | None
    """places, areas and holes of a skin that is no rectangle, as an object or as a CSV file; None: ``[shape]`` of the
    design, else a rectangle with that pitch"""
    accuracy: float | None
    """relative uncertainty of a cell's conductance up to which the cell is valid; None: 0.5, see
    :class:`ohmskin.circuits.ValidityRule`"""
    calibration: Calibration | str | Path | None
    """rest resistance and gain of each cell, or the file with them. A tare replaces the rest resistances and keeps its
    gains"""


@dataclass(frozen=True)
class Options:
    """Settings of a skin, checked; see :class:`SkinSettings`."""

    family: Family
    settings: RecordedSettings
    """settings that determine the frames; a recording holds them, too"""
    timeout_s: float
    delivery: Delivery
    queue: int
    reconnect_s: float
    serial_number: str | None
    """required serial number of the board; None: any"""

    @classmethod
    def of(
        cls,
        *,
        recorded: RecordedSettings = NOTHING_RECORDED,
        recording: str = "",
        serial_number: str | None = None,
        board: str | Path | Family = NATIVE,
        design: Design | str | Path | None = None,
        cell: Cell | str | Path | None = None,
        estimator: str | None = None,
        pitch: float | tuple[float, float] | None = None,
        shape: Shape | str | Path | None = None,
        accuracy: float | None = None,
        calibration: Calibration | str | Path | None = None,
        timeout: float = 3.0,
        delivery: Delivery | None = None,
        queue: int = QUEUE,
        reconnect: float = 10.0,
    ) -> Options:
        """Read the files and check the numbers of :class:`SkinSettings`; InputError.

        The settings of the ``recording`` that is played (its name; empty: a live board) hold where none are given.
        """
        timeout_s, queued = positive("timeout", timeout, "s"), count("queue", queue)
        reconnect_s = number("reconnect", reconnect, "s")
        if not reconnect_s >= 0:
            raise InputError(f"reconnect is {reconnect} s; expected at least 0")
        if estimator is not None and estimator not in ESTIMATORS:
            raise InputError(f"no estimator '{estimator}'; expected one of {', '.join(ESTIMATORS)}")
        ValidityRule.of(accuracy)
        if pitch is not None and shape is not None:
            raise InputError("a pitch and a shape; expected one of them, as the shape says where the cells are")
        given_place = pitch is not None or shape is not None
        family = recorded.family(recording) if recording and board == NATIVE else board_family(board)
        design = recorded.design if design is None else design
        design = family.files.get("design") if design is None else design
        cell = recorded.cell if cell is None else cell
        cell = family.files.get("cell") if cell is None else cell
        calibration = recorded.calibration if calibration is None else calibration
        settings = RecordedSettings(
            family.name,
            None if design is None else loaded("design", design, Design),
            None if cell is None else loaded("cell", cell, Cell),
            recorded.estimator if estimator is None else estimator,
            recorded.pitch if not given_place else None if pitch is None else _pitch_xy(pitch),
            recorded.accuracy if accuracy is None else accuracy,
            None if calibration is None else loaded("calibration", calibration, Calibration),
            family.tables if family.design is None else None,
            recorded.simulated,
            recorded.introduction,
            recorded.shape if not given_place else None if shape is None else loaded("shape", shape, Shape),
        )
        if settings.design is None and family.design is None and not family.has_description:
            given = [name for name in ("cell", "calibration") if getattr(settings, name) is not None]
            if given:
                raise InputError(
                    f"a {given[0]} for board '{family.name}', whose circuit is not known; expected a design, too "
                    "(--design DESIGN.toml, or design = in BOARD.toml)"
                )
        if delivery is None:
            delivery = "lossless" if recording else "newest"
        if delivery not in ("newest", "every", "lossless"):
            raise InputError(f"delivery '{delivery}'; expected newest, every or lossless")
        if serial_number is not None:
            of_kind("serial_number", serial_number, str, "text")
        return cls(family, settings, timeout_s, delivery, queued, reconnect_s, serial_number)


def _pitch_xy(pitch_m: float | tuple[float, float]) -> tuple[float, float]:
    """From one number for square cells, else from (x, y); InputError unless they are positive numbers."""
    pair = pitch_m if isinstance(pitch_m, tuple | list) else (pitch_m, pitch_m)
    if len(pair) != 2 or not all(0 < number("pitch", one, "m") < math.inf for one in pair):
        raise InputError(f"pitch is {pitch_m} m; expected more than 0, or two such numbers (x, y)")
    return float(pair[0]), float(pair[1])
