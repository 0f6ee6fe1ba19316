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
_CONTACT = {
    "type": "object",
    "properties": {
        "id": {"type": "integer"},
        "joined": {"type": "array", "items": {"type": "integer"}},
        "x_mm": _NUMBER,
        "y_mm": _NUMBER,
        "area_mm2": _NUMBER,
        "force_n": _NUMBER,
        "force_std_n": {"type": ["number", "null"]},
        "peak_kpa": _NUMBER,
        "interpolated_n": _NUMBER,
    },
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
_PLAIN_FIELDS = (
    "sequence",
    "device_time",
    "host_time",
    "lost_before",
    "skipped_before",
    "overrun",
    "reconnected",
    "rebooted",
)
_FRAME_SCHEMA = {
    "title": "ohmskin.Frame",
    "type": "object",
    "properties": {
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
        "contacts": {"type": "array", "items": _CONTACT},
    },
}

MESSAGE_SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    PRESSURE_TOPIC: _IMAGE_SCHEMA,
    COUNTS_TOPIC: _IMAGE_SCHEMA,
    FRAME_TOPIC: _FRAME_SCHEMA,
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
    values: dict[str, Any] = {name: getattr(frame, name) for name in _PLAIN_FIELDS}
    values["valid_cells"] = int(frame.valid.sum())
    values["largest_kpa"] = float(pressed.max()) if pressed.size and np.isfinite(pressed).all() else None
    values["contacts"] = [
        {
            "id": contact.id,
            "joined": list(contact.joined),
            "x_mm": contact.x_mm,
            "y_mm": contact.y_mm,
            "area_mm2": contact.area_mm2,
            "force_n": contact.force_n,
            "force_std_n": None if math.isnan(contact.force_std_n) else contact.force_std_n,
            "peak_kpa": contact.peak_kpa,
            "interpolated_n": contact.interpolated_n,
        }
        for contact in frame.contacts
    ]
    return values
