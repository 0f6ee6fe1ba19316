"""Sequences of frames as NumPy arrays by name, and as an xarray dataset with coordinates and units."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__
from ..common.arrays import AnyArray
from ..common.config import fingerprint
from ..common.extras import install_command
from ..common.geometry import Geometry
from ..errors import InputError, MissingExtra
from ._frame import Frame
from ._skin import BoardSkin

if TYPE_CHECKING:
    from xarray import Dataset

FRAME_NUMBERS = ("sequence", "device_time", "host_time", "lost_before", "overrun", "reconnected", "rebooted")
"""fields with a number for each frame"""
FRAME_GRIDS = ("counts", "rest_counts", "valid", "resistance", "pressure", "pressure_std")
"""fields with a number for each cell"""
_TYPES = {"counts": np.uint16}
_FLAGS = ("overrun", "reconnected", "rebooted", "valid")

_MEANINGS = {
    "sequence": ("1", "number of the frame, as the board sent it; NaN: the board does not number its frames"),
    "device_time": ("s", "time on the board's clock from its start to the start of the scan"),
    "host_time": ("s", "time since the epoch at which the frame's last byte came, delays of the line taken out"),
    "lost_before": ("1", "frames lost since the frame before; NaN: not known"),
    "overrun": ("1", "the board dropped frames before this one, because the host read too slowly"),
    "reconnected": ("1", "the port was opened anew since the frame before"),
    "rebooted": ("1", "the board started anew since the frame before"),
    "counts": ("1", "ADC code"),
    "rest_counts": ("1", "ADC code at rest by a tare, where the circuit is not known; else 0"),
    "valid": ("1", "the reading is a measurement"),
    "resistance": ("ohm", "resistance of the cell, with what the circuit adds taken out; NaN where not valid"),
    "pressure": ("kPa", "estimated pressure; where not valid the last estimate"),
    "pressure_std": ("kPa", "standard deviation of the pressure"),
}
"""units as UDUNITS and the CF conventions write them, and a long name"""


def stack(frames: Iterable[Frame], shape: tuple[int, int] | None = None) -> dict[str, AnyArray]:
    """The frames' fields by name: :data:`FRAME_NUMBERS` (frames,), :data:`FRAME_GRIDS` (frames, rows, columns).

    Args:
        frames: any number, of one skin.
        shape: (rows, columns), used if there are no frames; None: taken from the frames.

    Raises:
        InputError: there are no frames, and no shape is given; or frames differ in shape.

    """
    columns: dict[str, list[AnyArray]] = {name: [] for name in (*FRAME_NUMBERS, *FRAME_GRIDS)}
    for frame in frames:
        if shape is None:
            shape = frame.counts.shape
        if frame.counts.shape != shape:
            raise InputError("a frame of {} x {} cells among others of {} x {}".format(*frame.counts.shape, *shape))
        values = frame.as_dict()
        for name, column in columns.items():
            column.append(values[name])
    if shape is None:
        raise InputError("no frames; expected at least one, or a shape")
    return {
        name: np.array(column, dtype=_type(name)).reshape(len(column), *(shape if name in FRAME_GRIDS else ()))
        for name, column in columns.items()
    }


def to_xarray(frames: Iterable[Frame], skin: BoardSkin | None = None) -> Dataset:
    """The frames as a dataset with the dimensions ``time``, ``row`` and ``column``, ready for ``to_netcdf``.

    Args:
        frames: any number, of one skin.
        skin: source of the frames. Adds the places of the cells in mm (of a rectangle ``x_mm`` along ``column``,
            ``y_mm`` along ``row``; else these, maybe ``z_mm``, and ``area_mm2`` along both), and as attributes the
            board's family and serial number and hashes of design and cell.

    Raises:
        InputError: there are no frames and no skin, or frames differ in shape.
        MissingExtra: xarray is not installed.

    """
    try:
        from xarray import Dataset
    except ImportError as error:
        raise MissingExtra(f"datasets need xarray: {install_command('data')}") from error
    arrays = stack(frames, None if skin is None else skin.shape)
    rows, columns = arrays["pressure"].shape[1:]
    moments = np.round(arrays["host_time"] * 1e9).astype("datetime64[ns]")
    coordinates: dict[str, Any] = {
        "time": ("time", moments, {"long_name": "host_time as a date, UTC"}),
        "row": ("row", np.arange(rows)),
        "column": ("column", np.arange(columns)),
    }
    attributes = {"source": f"ohmskin {__version__}"}
    if skin is not None:
        coordinates |= _places(skin.geometry)
        attributes |= _origin(skin)
    variables = {}
    for name, array in arrays.items():
        units, meaning = _MEANINGS[name]
        dimensions = ("time", "row", "column")[: array.ndim]
        variables[name] = (dimensions, array, {"units": units, "long_name": meaning})
    return Dataset(variables, coords=coordinates, attrs=attributes)


def _places(geometry: Geometry) -> dict[str, Any]:
    """Coordinates of the cells."""
    meaning = {"units": "mm", "long_name": "middle of the cell"}
    if geometry.pitch_m is not None:
        x_mm, y_mm = geometry.places_mm[0, :, 0], geometry.places_mm[:, 0, 1]
        return {"x_mm": ("column", x_mm, meaning), "y_mm": ("row", y_mm, meaning)}
    both = ("row", "column")
    found = {axis: (both, geometry.places_mm[..., k], meaning) for k, axis in enumerate(geometry.axes)}
    area = {"units": "mm2", "long_name": "area of the cell; 0 where there is none"}
    return found | {"area_mm2": (both, geometry.areas_mm2, area)}


def _origin(skin: BoardSkin) -> dict[str, str]:
    known = {
        "board": skin.family.name,
        "serial_number": skin.serial_number,
        "firmware": "" if skin.identity is None else skin.identity.firmware,
        "design_sha256": " ".join(fingerprint(board.design) for board in skin.boards if board.knows_circuit),
        "cell_sha256": " ".join(fingerprint(board.cell) for board in skin.boards if board.cell is not None),
        "port": skin.port_name,
    }
    return {name: value for name, value in known.items() if value}


def _type(name: str) -> Any:
    return np.bool_ if name in _FLAGS else _TYPES.get(name, np.float64)
