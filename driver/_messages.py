"""Frames as JSON messages that Foxglove shows without plugins, in recordings and live through its SDK.

``/ohmskin/pressure`` is an image, ``foxglove.RawImage`` in the encoding 32FC1: one float32 in kPa for each cell.
A board whose circuit is not known has ``/ohmskin/counts`` in its place: counts above those at rest.
A skin with places of its own has ``/ohmskin/cells``, too, a ``foxglove.PointCloud`` with a point in m for each cell.
``/ohmskin/frame`` has the numbers of the frame and its contacts.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..common.arrays import FloatArray, SingleArray
from ._frame import Frame

PRESSURE_TOPIC, FRAME_TOPIC = "/ohmskin/pressure", "/ohmskin/frame"
COUNTS_TOPIC, CELLS_TOPIC = "/ohmskin/counts", "/ohmskin/cells"

_NUMBER = {"type": "number"}
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_CONTACT_FIELDS = {
    "id": {"type": "integer"},
    "joined": {"type": "array", "items": {"type": "integer"}},
    "x_mm": _NUMBER,
    "y_mm": _NUMBER,
    "z_mm": {"type": ["number", "null"]},
    "area_mm2": _NUMBER,
    "force_n": _NUMBER,
    "force_std_n": {"type": ["number", "null"]},
    "peak_kpa": _NUMBER,
    "interpolated_n": _NUMBER,
}
_WHOLE, _TEXT, _DATA = {"type": "integer"}, {"type": "string"}, {"type": "string", "contentEncoding": "base64"}
_POINTS = ("x", "y", "z", "value")
"""fields of a point, float32 each: m, and kPa or counts above those at rest, as in the image"""
_FLOAT32 = 7
"""of foxglove.PackedElementField"""
_UNMOVED = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
_HEAD = {"timestamp": _TIME, "frame_id": _TEXT}
_IMAGE_FIELDS = {"width": _WHOLE, "height": _WHOLE, "encoding": _TEXT, "step": _WHOLE, "data": _DATA}
_CLOUD_FIELDS = {
    "pose": {"type": "object"},
    "point_stride": _WHOLE,
    "fields": {"type": "array", "items": {"type": "object"}},
    "data": _DATA,
}
_FRAME_FIELDS = {
    "sequence": {"type": ["integer", "null"]},
    "device_time": {"type": ["number", "null"]},
    "host_time": _NUMBER,
    "lost_before": {"type": ["integer", "null"]},
    "skipped_before": {"type": "integer"},
    "overrun": {"type": "boolean"},
    "reconnected": {"type": "boolean"},
    "rebooted": {"type": "boolean"},
    "valid_cells": {"type": "integer"},
    "largest_kpa": {"type": ["number", "null"]},
    "contacts": {"type": "array", "items": {"type": "object", "properties": _CONTACT_FIELDS}},
}


def _schema(title: str, fields: Mapping[str, Any]) -> Mapping[str, Any]:
    return {"title": title, "type": "object", "properties": fields}


MESSAGE_SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    PRESSURE_TOPIC: _schema("foxglove.RawImage", _HEAD | _IMAGE_FIELDS),
    COUNTS_TOPIC: _schema("foxglove.RawImage", _HEAD | _IMAGE_FIELDS),
    CELLS_TOPIC: _schema("foxglove.PointCloud", _HEAD | _CLOUD_FIELDS),
    FRAME_TOPIC: _schema("ohmskin.Frame", _FRAME_FIELDS),
}
"""topic -> JSON schema, named by its title"""


def messages_of(frame: Frame) -> dict[str, dict[str, Any]]:
    """The frame's messages, by topics of :data:`MESSAGE_SCHEMAS`."""
    only_counts = bool((frame.valid & np.isnan(frame.resistance)).any())
    topic, values = (COUNTS_TOPIC, frame.change) if only_counts else (PRESSURE_TOPIC, frame.pressure)
    shown = {topic: _image(frame, values), FRAME_TOPIC: _numbers(frame)}
    return shown if frame.geometry.pitch_m is not None else shown | {CELLS_TOPIC: _cloud(frame, values)}


def points_of(frame: Frame, values: FloatArray) -> SingleArray:
    """(cells, 4) x, y and z in m, and the value, of each cell that there is. ``values`` are (rows, columns)."""
    there = frame.geometry.exists
    places = frame.geometry.places_mm[there]
    points = np.zeros((len(places), len(_POINTS)), dtype="<f4")
    points[:, : places.shape[1]], points[:, -1] = places / 1e3, values[there]
    return points


def _cloud(frame: Frame, values: FloatArray) -> dict[str, Any]:
    points = points_of(frame, values)
    return _head(frame) | {
        "pose": _UNMOVED,
        "point_stride": points.strides[0],
        "fields": [{"name": name, "offset": 4 * k, "type": _FLOAT32} for k, name in enumerate(_POINTS)],
        "data": base64.b64encode(points.tobytes()).decode(),
    }


def _head(frame: Frame) -> dict[str, Any]:
    seconds, nanoseconds = divmod(round(frame.host_time * 1e9), 10**9)
    return {"timestamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": "skin"}


def _image(frame: Frame, values: FloatArray) -> dict[str, Any]:
    image = np.ascontiguousarray(values, dtype="<f4")
    rows, columns = image.shape
    return _head(frame) | {
        "width": columns,
        "height": rows,
        "encoding": "32FC1",
        "step": 4 * columns,
        "data": base64.b64encode(image.tobytes()).decode(),
    }


def _numbers(frame: Frame) -> dict[str, Any]:
    pressed = frame.pressure[frame.valid]
    derived = {
        "valid_cells": int(frame.valid.sum()),
        "largest_kpa": float(pressed.max()) if pressed.size and np.isfinite(pressed).all() else None,
        "contacts": [{name: _json(getattr(contact, name)) for name in _CONTACT_FIELDS} for contact in frame.contacts],
    }
    return {name: derived[name] if name in derived else getattr(frame, name) for name in _FRAME_FIELDS}


def _json(value: Any) -> Any:
    """A value as JSON has it, which knows no NaN."""
    return list(value) if isinstance(value, tuple) else None if value is None or math.isnan(value) else value
