"""``Frame``: one scan of the skin, as the driver hands it out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import AnyArray, BoolArray, FloatArray
from ..frozen import frozen
from ._contacts import Contact
from ._later import Later


@frozen
@dataclass(slots=True, eq=False)
class Frame:
    """One scan of the skin. Arrays are (rows, columns) and read-only."""

    sequence: int | None
    """the board's number of this frame, modulo 2**32; None: the board does not number its frames"""
    device_time: float | None
    """s on the board's clock, from its start to the start of this scan; None: the board tells no time"""
    host_time: float
    """s since the epoch at which the frame's last byte came, delays of line and operating system taken out"""
    monotonic_time: float
    """the same moment in s on the clock of :func:`time.monotonic`, which is never set"""
    lost_before: int | None
    """frames that the line or the board lost since the frame that was taken before this one; None: not known"""
    skipped_before: int
    """frames that came in that time and were not taken, because their reader was slower than the board"""
    overrun: bool
    """the board said, since the frame taken before, that it dropped frames because the host read too slowly"""
    reconnected: bool
    """the port was opened anew since the frame taken before"""
    rebooted: bool
    """the board started anew since the frame taken before"""
    estimator_restarted: bool
    """the estimator has no memory of earlier frames: the first frame, after a tare, or after a gap above 60 s"""
    repeated: bool
    """this reader had the frame before: ``latest`` found no newer one. What happened before it is not told twice: the
    counts are then 0 (or None), and the marks above False"""
    counts: NDArray[np.uint16] = field(repr=False)
    """as the board sent them"""
    valid: BoolArray = field(repr=False)
    """where ``resistance`` is a measurement: known as well as was asked for (``Skin.open(accuracy=...)``)"""
    reason: NDArray[np.int8] = field(repr=False)
    """why a cell is not valid: a :class:`ohmskin.circuits.Reason` each, 0 where it is"""
    resistance: FloatArray = field(repr=False)
    """ohm of the cells, with what the circuit adds taken out; NaN where not valid"""
    pressure: FloatArray = field(repr=False)
    """kPa, estimated from this and earlier frames; where not valid the last estimate, NaN before the first"""
    _std: Later = field(repr=False)
    _contacts: Callable[[], tuple[Contact, ...]] = field(repr=False)
    _now: Callable[[], float] = field(repr=False)

    @property
    def age(self) -> float:
        """Seconds from the frame's arrival until now. For a recording, now is the recording's present time."""
        return self._now() - self.monotonic_time

    def again(self) -> Frame:
        """The same frame for a reader who has had it: its arrays, without what was told with it."""
        return replace(
            self,
            lost_before=None if self.lost_before is None else 0,
            skipped_before=0,
            overrun=False,
            reconnected=False,
            rebooted=False,
            estimator_restarted=False,
            repeated=True,
        )

    @property
    def pressure_std(self) -> FloatArray:
        """kPa (rows, columns), standard deviation of ``pressure``; NaN where the estimator states none.

        Computed when asked for, and then kept.
        """
        return self._std()

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """What touches the skin, the largest force first. Computed when asked for; ids last from frame to frame."""
        return self._contacts()

    def __reduce__(self) -> tuple[Callable[..., Frame], tuple[dict[str, Any], float]]:
        """For pickle and copy: contacts are computed now, and the age goes on with this machine's monotonic clock."""
        values = {item.name: getattr(self, item.name) for item in fields(self) if item.name[0] != "_"}
        values |= {"pressure_std": self.pressure_std, "contacts": self.contacts}
        return _restored, (values, self._now() - time.monotonic())

    def as_dict(self) -> dict[str, AnyArray]:
        """All fields as NumPy arrays: those per cell (rows, columns), the others without axes.

        Missing numbers are NaN, missing counts (``sequence``, ``lost_before``) are -1. ``age`` is that of the call.
        """
        values: dict[str, Any] = {item.name: getattr(self, item.name) for item in fields(self) if item.name[0] != "_"}
        values["pressure_std"] = self.pressure_std
        for name in ("sequence", "lost_before"):
            values[name] = -1 if values[name] is None else values[name]
        values["device_time"] = np.nan if self.device_time is None else self.device_time
        values["age"] = self.age
        return {name: np.asarray(value) for name, value in values.items()}


def _restored(values: dict[str, Any], clock_ahead_s: float) -> Frame:
    """A frame that was pickled: ``clock_ahead_s`` is what its clock showed beside the monotonic clock."""
    std, contacts = values.pop("pressure_std"), values.pop("contacts")
    return Frame(
        **values, _std=Later(lambda: std), _contacts=lambda: contacts, _now=lambda: time.monotonic() + clock_ahead_s
    )
