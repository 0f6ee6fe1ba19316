"""Stream accounting: packets to numbered, timed frames, with losses, duplicates and reboots counted. No I/O."""

from __future__ import annotations

import enum
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ProtocolError
from ..wire import Flag, FramePacket
from ._clock import ClockMap, Pace
from ._converted import Converted
from ._port import Arrival
from ._spacing import ArrivalTimes
from ._statistics import Counters
from ._tuning import (
    BUFFERED_S,
    CLOCK_SET_S,
    CLOCK_SET_STEPS,
    FASTER,
    FASTEST_CLOCK,
    LEAST_PERIOD_US,
    LEAST_STEP_S,
    REMEMBERED,
)

HALF_RANGE = 2**31
_NO_FLAGS = Flag.NONE  # operations on flags take 1 us each


@dataclass(slots=True, eq=False)  # frozen ones take 2 us more to make; nobody changes one
class RawFrame:
    """One frame as it came. Totals count from the opening of the skin up to and including this frame."""

    index: int
    """number of this frame among those that came, from 1"""
    sequence: int | None
    device_time: float | None
    counts: NDArray[np.uint16]
    """(rows, columns)"""
    host_time: float
    monotonic_time: float
    time_s: float
    """on the estimator's time scale, which increases evenly, also over reboots"""
    lost: int | None
    """total of lost frames; None: not known"""
    overruns: int
    """total"""
    reconnects: int
    """total"""
    reboots: int
    """total"""
    absent: tuple[int, ...] = ()
    """cells, counted row by row, of which the board has sent no count"""
    converted: Converted | None = None
    """None: not converted yet, skipped, or it does not fit the design; written by :class:`._frames.Frames` only"""


class _Succession(enum.Enum):
    """Relation of a packet to the one before it."""

    NEXT = enum.auto()
    CLOCK_SET = enum.auto()
    OVERTAKEN = enum.auto()
    REBOOT = enum.auto()


class FrameStream:
    """Packets of one board in order, over reboots and reconnections.

    A frame number beyond the next one tells how many frames were lost. Another boot id is a reboot: numbers and time
    then start from 0. A frame that came already is dropped. With an unchanged boot id:

    ================  ==================  =================================================================
    number            time                meaning
    ================  ==================  =================================================================
    goes on           goes on             the next frame
    goes on           goes back           the next frame; the board's clock was set, or has wrapped
    back by up to 64  goes back           a packet that was overtaken: dropped, and one of the lost
    further back      goes back           a reboot of a board that does not change its boot id
    back by up to 64  goes on             a fault
    further back      goes on             the next frame, numbered anew
    ================  ==================  =================================================================

    Where the board's time goes as no oscillator does (:class:`.Pace`), frames have the times of their arrival. The
    estimator follows the board's time nevertheless where it is fast, or ``simulated``: a simulation's time is exact.

    A jump of the numbers by more than 64 is a new numbering, too, if a board at FASTER times its usual rate could not
    have sent the frames between in the time that has passed. A new numbering is a resynchronisation, not a loss.
    """

    def __init__(self, name: str, counters: Counters, *, simulated: bool = False) -> None:
        self.name = name
        """name of the port, for messages"""
        self.clock = ClockMap()
        self._simulated = simulated
        self._arrivals = ArrivalTimes()
        """for boards without a clock, and for those whose clock does not go as one"""
        self.counters = counters
        self._begun = False
        """whether a frame has come"""
        self._expected: int | None = None
        self._boot_id: int | None = None
        self._latest_us: int | None = None
        self._latest_monotonic = 0.0
        self._time_s = 0.0
        self._usual_us = 0.0
        """board time from one frame number to the next, by the last two frames; 0: not known"""
        self._recent: deque[tuple[int | None, int | None, int | None]] = deque(maxlen=REMEMBERED)
        """boot ids, sequence numbers and times of the last numbered frames"""

    def announce(self, sequence: int | None, boot_id: int | None) -> None:
        """Take the number of the first frame, as announced by the packets before it."""
        if not self._begun:
            self._expected, self._boot_id = sequence, boot_id

    def arrive(self, arrival: Arrival, frames: int) -> None:
        """Take the number of frames that arrived together, before :meth:`add` numbers them one by one."""
        self._arrivals.arrive(arrival.received_at, frames)

    def end(self, sequence: int, boot_id: int | None, time_us: int) -> None:
        """Count the frames that the line lost before ``sequence``, the number that would have come next.

        Args:
            sequence: from the packet with which the board announces its end.
            boot_id: of that packet.
            time_us: time of the board's clock in that packet.

        """
        since_us = self._latest_us or 0
        if self._begun and boot_id != self._boot_id:
            self.counters.reboots += 1
            self._expected = since_us = 0
        missing = 0 if self._expected is None else (sequence - self._expected) % 2**32
        if self._may_be_lost(missing, max(time_us - since_us, 0) + 1e6 * BUFFERED_S, self._usual_us):
            self.counters.lost = (self.counters.lost or 0) + missing
            self._expected = sequence

    def add(self, packet: FramePacket, arrival: Arrival) -> RawFrame | None:
        """The next frame; None if the packet came before.

        Raises:
            ProtocolError: the frame's number goes backwards although the board has not restarted. The stream
                continues with the frame after this one.

        """
        counters = self.counters
        sequence, time_us = packet.sequence, packet.time_us
        found, missing, latest_us = _Succession.NEXT, 0, self._latest_us
        if (
            sequence is not None
            and sequence == self._expected
            and packet.boot_id == self._boot_id
            and not (time_us is None or latest_us is None or time_us <= latest_us)
        ):  # no earlier frame has such a number and time: the usual case
            self._expected = (sequence + 1) % 2**32
        else:
            if sequence is not None and (packet.boot_id, sequence, time_us) in self._recent:
                counters.duplicates += 1
                return None
            found = self._succession(packet)
            if found is _Succession.OVERTAKEN:
                counters.late += 1
                self._recent.append((packet.boot_id, sequence, time_us))
                return None
            if found is not _Succession.NEXT:
                self._begin_anew(packet, found)
            self._boot_id = packet.boot_id
            missing = self._count_lost(packet, arrival, found)
        if sequence is not None:
            self._recent.append((packet.boot_id, sequence, time_us))
        counters.frames += 1
        if packet.flags is not _NO_FLAGS:
            counters.overruns += bool(packet.flags & Flag.OVERRUN)
        device_s = None if time_us is None else time_us / 1e6
        monotonic = self._map_time(device_s, arrival)
        self._advance(time_us, monotonic, missing, time_runs_through=found is _Succession.NEXT)
        self._begun = True
        host_time = monotonic + (arrival.wall_time - arrival.received_at)
        return RawFrame(  # by position: keywords take half as long again
            counters.frames,
            sequence,
            device_s,
            packet.counts,
            host_time,
            monotonic,
            self._time_s,
            counters.lost,
            counters.overruns,
            counters.reconnects,
            counters.reboots,
            packet.absent,
        )

    def _succession(self, packet: FramePacket) -> _Succession:
        """Relation of a packet to the one before: the table of this class."""
        boot_id, before = packet.boot_id, self._boot_id
        if boot_id != before and boot_id is not None and before is not None:
            return _Succession.REBOOT
        if packet.time_us is None or self._latest_us is None or packet.time_us >= self._latest_us:
            return _Succession.NEXT
        if packet.sequence is None or self._expected is None:
            return _Succession.REBOOT
        behind = (self._expected - packet.sequence) % 2**32
        if not 0 < behind <= HALF_RANGE:
            return _Succession.CLOCK_SET
        return _Succession.OVERTAKEN if behind <= REMEMBERED else _Succession.REBOOT

    def _begin_anew(self, packet: FramePacket, found: _Succession) -> None:
        """Restart the board's clock, and after a reboot its numbers, too."""
        counters = self.counters
        counters.clock_steps += self.clock.steps + (found is _Succession.CLOCK_SET)
        self.clock = ClockMap()
        counters.clock = None
        if found is _Succession.REBOOT:
            counters.reboots += 1
            counters.times_s.clear()
            self._recent.clear()
            self._expected = None if packet.sequence is None else 0

    def _passed_us(self, time_us: int | None, arrival: Arrival, found: _Succession) -> float:
        """The longest time in us in which frames may have been lost before this one."""
        if time_us is not None and (found is _Succession.REBOOT or not self._begun):
            return time_us  # at most the time since the board's start
        if time_us is not None and self._latest_us is not None and found is _Succession.NEXT:
            return time_us - self._latest_us
        return 1e6 * (arrival.received_at - self._latest_monotonic + BUFFERED_S)

    @staticmethod
    def _may_be_lost(missing: int, passed_us: float, usual_us: float) -> bool:
        """Whether a board may have sent so many frames that were lost; otherwise its numbering is new.

        Args:
            missing: numbers between two frames that came, modulo 2^32.
            passed_us: time between these two.
            usual_us: usual time from frame to frame; 0: not known.

        """
        most = passed_us / max(usual_us / FASTER, LEAST_PERIOD_US)
        return missing < min(most, HALF_RANGE)

    def _count_lost(self, packet: FramePacket, arrival: Arrival, found: _Succession) -> int:
        """Count the frames missing before this one; returns their number, 0 if it is not known.

        Args:
            packet: the frame.
            arrival: of its last byte.
            found: relation to the frame before.

        Raises:
            ProtocolError: as for :meth:`add`.

        """
        if packet.sequence is None:
            self.counters.lost = None
            return 0
        expected, self._expected = self._expected, (packet.sequence + 1) % 2**32
        missing = 0 if expected is None else (packet.sequence - expected) % 2**32
        if missing > REMEMBERED:  # rare; otherwise not examined further
            if missing >= 2**32 - REMEMBERED:
                raise ProtocolError(
                    f"{self.name}: frame {packet.sequence} came where {expected} was next, "
                    "yet the board has not started anew"
                )
            usual_us = self._usual_us if packet.time_us is not None else 1e6 * self._arrivals.usual_s
            if not self._may_be_lost(missing, self._passed_us(packet.time_us, arrival, found), usual_us):
                self.counters.resyncs += 1
                missing = 0
        self.counters.lost = (self.counters.lost or 0) + missing
        return missing

    def _map_time(self, device_s: float | None, arrival: Arrival) -> float:
        arrived_s = self._arrivals.next(arrival.received_at)
        if device_s is None:
            return arrived_s
        before, monotonic = self.clock.pace, self.clock.add(device_s, arrival.received_at)
        if self.clock.pace is not before and not self._simulated:
            self._report_pace()
        if self.clock.pace is not Pace.EVEN:
            return arrived_s
        self.counters.delays_s.append(arrival.received_at - monotonic)
        return monotonic

    def _report_pace(self) -> None:
        """Say once that the board's time is no clock's, and as long as it is none."""
        reported = self.counters.clock
        self.counters.clock = None
        if self.clock.pace is not Pace.EVEN and self.clock.rate <= FASTEST_CLOCK:
            found = f"advances by {self.clock.rate:.2g} s in a second" if self.clock.rate else "stands"
            self.counters.clock = (
                f"{self.name}: the board's clock {found}, which no oscillator does: frames have the times at which "
                "they came, and bytes that wait in buffers no longer show in their ages"
            )
            if reported is None:
                self.counters.notices.append(self.counters.clock)

    def _advance(self, time_us: int | None, monotonic: float, missing: int, *, time_runs_through: bool) -> None:
        """Advance the estimator's time: by the board's clock if it runs through, else by the host's."""
        if self._begun:
            step = monotonic - self._latest_monotonic
            slow = self.clock.pace is Pace.SLOW and not self._simulated
            if time_us is not None and self._latest_us is not None and time_runs_through and not slow:
                passed_us = time_us - self._latest_us
                # Only a jump of the board's clock exceeds both the host's time and the usual time of frames. At the
                # emulator's fast clock every step exceeds the host's time.
                usual_us = self._usual_us * (missing + 1)
                if passed_us > 1e6 * (step + CLOCK_SET_S) and 0 < CLOCK_SET_STEPS * usual_us < passed_us:
                    self.counters.clock_steps += 1
                else:
                    step = passed_us / 1e6
                self._usual_us = passed_us / (missing + 1)
            self._time_s += step if step > LEAST_STEP_S else LEAST_STEP_S
        self._latest_us, self._latest_monotonic = time_us, monotonic
        self.counters.times_s.append(self._time_s)
