"""Frames as JSON messages that Foxglove shows without plugins, in recordings and live through its SDK.

``/ohmskin/pressure`` is an image, ``foxglove.RawImage`` in the encoding 32FC1: one float32 in kPa for each cell.
A board whose circuit is not known has ``/ohmskin/counts`` in its place: counts above those at rest.
``/ohmskin/frame`` has the numbers of the frame and its contacts.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..common.arrays import FloatArray
from ._frame import Frame

PRESSURE_TOPIC, FRAME_TOPIC = "/ohmskin/pressure", "/ohmskin/frame"
COUNTS_TOPIC = "/ohmskin/counts"

_NUMBER = {"type": "number"}
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_CONTACT_FIELDS = {
    "id": {"type": "integer"},
    "joined": {"type": "array", "items": {"type": "integer"}},
    "x_mm": _NUMBER,
    "y_mm": _NUMBER,
    "area_mm2": _NUMBER,
    "force_n": _NUMBER,
    "force_std_n": {"type": ["number", "null"]},
    "peak_kpa": _NUMBER,
    "interpolated_n": _NUMBER,
}
_IMAGE_SCHEMA = {
    "title": "foxglove.RawImage",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "width": {"type": "integer"},
        "height": {"type": "integer"},
        "encoding": {"type": "string"},
        "step": {"type": "integer"},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
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

MESSAGE_SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    PRESSURE_TOPIC: _IMAGE_SCHEMA,
    COUNTS_TOPIC: _IMAGE_SCHEMA,
    FRAME_TOPIC: {"title": "ohmskin.Frame", "type": "object", "properties": _FRAME_FIELDS},
}
"""topic -> JSON schema, named by its title"""


def messages_of(frame: Frame) -> dict[str, dict[str, Any]]:
    """The frame's messages, by topics of :data:`MESSAGE_SCHEMAS`."""
    only_counts = bool((frame.valid & np.isnan(frame.resistance)).any())
    topic, values = (COUNTS_TOPIC, frame.change) if only_counts else (PRESSURE_TOPIC, frame.pressure)
    return {topic: _image(frame, values), FRAME_TOPIC: _numbers(frame)}


def _image(frame: Frame, values: FloatArray) -> dict[str, Any]:
    image = np.ascontiguousarray(values, dtype="<f4")
    rows, columns = image.shape
    seconds, nanoseconds = divmod(round(frame.host_time * 1e9), 10**9)
    return {
        "timestamp": {"sec": seconds, "nsec": nanoseconds},
        "frame_id": "skin",
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
    return list(value) if isinstance(value, tuple) else None if math.isnan(value) else value
