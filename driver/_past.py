"""Checkpoint of an open skin: the state from which the replay of a recording that began in the middle continues.

A recorder that joins an open skin (:class:`~ohmskin.driver.Recorder`) writes this state before the first bytes. The
replay starts from the state, and therefore gives the same frames as the skin. The state is plain numbers, so that
recordings from untrusted sources can be opened.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ..common.arrays import FloatArray
from ..common.config import Finite, parse
from ..errors import InputError

MOST_NUMBERS = 2**27
"""limit of one array: a gigabyte"""
Index = Annotated[int, Field(ge=0, lt=2**64)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Block(_Part):
    """An array of float64, bit for bit."""

    shape: tuple[Annotated[int, Field(ge=0)], ...]
    data: str
    """base64 of little-endian doubles"""

    @classmethod
    def of(cls, array: FloatArray) -> Self:
        """The block of an array."""
        data = np.ascontiguousarray(array, dtype="<f8").tobytes()
        return cls(shape=array.shape, data=base64.b64encode(data).decode())

    def array(self) -> FloatArray:
        """The array; InputError if shape and data do not match."""
        try:
            data = base64.b64decode(self.data, validate=True)
        except ValueError as error:
            raise InputError(f"an array that is no base64: {error}") from error
        if math.prod(self.shape) > MOST_NUMBERS or len(data) != 8 * math.prod(self.shape):
            raise InputError(f"an array of shape {self.shape} with {len(data)} bytes; expected 8 for each number")
        return np.frombuffer(data, dtype="<f8").astype(np.float64).reshape(self.shape)


class ClockPast(_Part):
    """State of a :class:`._clock.ClockMap`; times in s."""

    steps: Index
    origin: tuple[Finite, Finite] | None
    buckets: tuple[tuple[Finite, Finite], ...]
    bucket_ends: Finite
    least: tuple[Finite, Finite]
    drift: Finite
    anchor: tuple[Finite, Finite]


class ArrivalsPast(_Part):
    """State of :class:`._spacing.ArrivalTimes`; times in s."""

    last: Finite | None = None
    intervals: tuple[Finite, ...] = ()


class StreamPast(_Part):
    """State of a :class:`._stream.FrameStream`."""

    begun: bool
    """whether a frame has come"""
    expected: Index | None
    boot_id: Index | None
    latest_us: Index | None
    latest_monotonic: Finite
    time_s: Finite
    usual_us: Annotated[float, Field(ge=0, lt=math.inf)] = 0.0
    recent: tuple[tuple[Index | None, Index | None, Index | None], ...]
    numbered: bool
    """whether the board numbers its frames, as far as is known"""
    clock: ClockPast
    arrivals: ArrivalsPast = ArrivalsPast()


class MeasurementPast(_Part):
    """State of a :class:`._convert.Converter` after its last frame."""

    time_s: Finite | None
    """of the last frame; None: there was none"""
    rest_ohm: Block | None
    """(rows, columns) rest resistances in use; None: those of the data sheet"""
    noise_steps: Annotated[float, Field(ge=0, le=2**16)]
    """ADC steps, standard deviation of the readings"""
    counts: Block | None
    """(rows, columns) of the last frame"""
    rest_spread: Annotated[float, Field(ge=0, lt=math.inf)] | None = None
    """relative spread of the rest resistances about the data sheet; None: not measured yet"""
    restarted: bool
    """whether the estimator has no memory of the last frame"""
    estimator: dict[str, Block] | None
    """from :meth:`ohmskin.cell.Estimator.state`"""
    line_faults: dict[str, Block] | None = None
    """from :meth:`._line_faults.LineFaults.state`"""

    def estimator_state(self) -> dict[str, FloatArray]:
        """Arrays for :meth:`ohmskin.cell.Estimator.restore`."""
        return {name: block.array() for name, block in (self.estimator or {}).items()}


class Past(_Part):
    """The complete state."""

    heard: str
    """base64 of bytes: the board's identity and description, then the last bytes before the join, which may end within
    a packet"""
    stream: StreamPast
    measurement: MeasurementPast

    @classmethod
    def of(cls, heard: bytes, stream: StreamPast, measurement: MeasurementPast) -> Self:
        """Put the parts together."""
        return cls(heard=base64.b64encode(heard).decode(), stream=stream, measurement=measurement)

    @classmethod
    def parse(cls, tables: object, source: str) -> Self:
        """Check the tables of a file; ``source`` names it in messages. Raises InputError."""
        if not isinstance(tables, Mapping):
            raise InputError(f"{source}: expected a table")
        past = parse(tables, cls, source=source)
        try:
            base64.b64decode(past.heard, validate=True)
        except ValueError as error:
            raise InputError(f"{source}: heard: is no base64: {error}") from error
        return past

    def heard_bytes(self) -> bytes:
        """The bytes of :attr:`heard`."""
        return base64.b64decode(self.heard)

    def tables(self) -> dict[str, object]:
        """Plain values for JSON. Python writes floats so that they are read back bit for bit."""
        values: dict[str, object] = json.loads(json.dumps(self.model_dump()))
        return values
