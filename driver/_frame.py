"""``Frame``: one scan of the skin, as the driver delivers it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import AnyArray, BoolArray, FloatArray
from ..common.geometry import Geometry
from ._contacts import Contact


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Frame:
    """One scan of the skin. Arrays are (rows, columns) and read-only."""

    sequence: int | None
    """the board's number of this frame, modulo 2**32; None: the board does not number its frames"""
    device_time: float | None
    """s on the board's clock, from its start to the start of this scan; None: the board tells no time"""
    host_time: float
    """arrival of the frame's last byte in s since the epoch, corrected for the delays of line and operating system"""
    monotonic_time: float
    """the same moment in s on the clock of :func:`time.monotonic`, which is never set"""
    lost_before: int | None
    """frames that the line or the board lost since the previous frame that this reader took; None: not known"""
    skipped_before: int
    """frames that arrived in that time but were not taken, because the reader was slower than the board"""
    overrun: bool
    """since the previous frame taken, the board reported dropped frames, because the host read too slowly"""
    reconnected: bool
    """the port was reopened since the previous frame taken"""
    rebooted: bool
    """the board restarted since the previous frame taken"""
    estimator_restarted: bool
    """the estimator has no memory of earlier frames: the first frame, after a tare, or after a gap above 60 s"""
    repeated: bool
    """``latest`` found no newer frame, so this reader gets the same frame again. Events are not reported twice: the
    counts above are then 0 (or None), and the flags above False"""
    counts: NDArray[np.uint16] = field(repr=False)
    """as the board sent them"""
    valid: BoolArray = field(repr=False)
    """where ``resistance`` is a measurement, within the uncertainty asked for (``Skin.open(accuracy=...)``), and where
    the cells are known a ``pressure`` follows from it"""
    reason: NDArray[np.int8] = field(repr=False)
    """why a cell is not valid: a :class:`ohmskin.circuits.Reason` each, 0 for valid cells"""
    resistance: FloatArray = field(repr=False)
    """cell resistances in ohm, corrected for the readout circuit; NaN where not valid, unless it is ``BEYOND_MODEL``"""
    pressure: FloatArray = field(repr=False)
    """kPa, estimated from this frame and earlier ones; where not valid the last estimate, NaN before the first"""
    pressure_std: FloatArray = field(repr=False)
    """kPa, standard deviation of ``pressure``; NaN where the estimator states none"""
    rest_counts: FloatArray = field(repr=False)
    """counts at rest by a tare, where the board's circuit is not known; else, and without a tare, 0"""
    geometry: Geometry = field(repr=False)
    """places and areas of the cells, and where there is none; the same for all frames of a skin"""
    _contacts: Callable[[], tuple[Contact, ...]] = field(repr=False)
    _now: Callable[[], float] = field(repr=False)

    @property
    def age(self) -> float:
        """Seconds from the frame's arrival until now. For a recording, now is the recording's present time."""
        return self._now() - self.monotonic_time

    def again(self) -> Frame:
        """The same frame for a reader who has had it already: same arrays, without the events reported before."""
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
    def change(self) -> FloatArray:
        """Counts above those at rest (rows, columns); NaN where not valid. For boards whose circuit is not known."""
        return np.where(self.valid, self.counts - self.rest_counts, np.nan)

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Contacts on the skin, the largest force first. Computed on demand; ids persist from frame to frame."""
        return self._contacts()

    def __reduce__(self) -> tuple[Callable[..., Frame], tuple[dict[str, Any], float]]:
        """For pickle and copy: contacts are computed first, and the age continues on this machine's monotonic clock."""
        values = {item.name: getattr(self, item.name) for item in fields(self) if item.name[0] != "_"}
        values["contacts"] = self.contacts
        return _restored, (values, self._now() - time.monotonic())

    def as_dict(self) -> dict[str, AnyArray]:
        """All fields but the geometry as NumPy arrays: those per cell (rows, columns), the others without axes.

        What is not known is NaN. ``age`` is the age at this call.
        """
        names = [item.name for item in fields(self) if item.name[0] != "_" and item.name != "geometry"]
        values: dict[str, Any] = {name: getattr(self, name) for name in names}
        for name in ("sequence", "lost_before", "device_time"):
            values[name] = np.nan if values[name] is None else float(values[name])
        values["age"] = self.age
        return {name: np.asarray(value) for name, value in values.items()}


def _restored(values: dict[str, Any], clock_ahead_s: float) -> Frame:
    """A frame from a pickle; ``clock_ahead_s`` is its clock minus the monotonic clock."""
    contacts = values.pop("contacts")
    return Frame(**values, _contacts=lambda: contacts, _now=lambda: time.monotonic() + clock_ahead_s)
