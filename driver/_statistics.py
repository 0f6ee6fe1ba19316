"""Link statistics: frames received and lost, and the age of frames when they were taken."""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..circuits import Reason
from ._tuning import RECENT_FRAMES

PERCENTS = (50, 95, 99, 100)


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """A snapshot of :meth:`Skin.stats`. Counts are since the skin was opened."""

    frames: int
    """frames that came intact"""
    lost: int | None
    """frames lost on the line or by the board; None: the board does not number its frames"""
    overruns: int
    """number of reports by the board that it dropped frames because the host read too slowly"""
    corrupt: int
    """stretches of bytes that were no packets"""
    why_corrupt: str
    """why the newest of them was none; empty: there was none"""
    resyncs: int
    """times that the numbers of frames jumped in a way that no time explains"""
    reconnects: int
    """number of times that the port was reopened"""
    reboots: int
    """number of times that the board restarted"""
    duplicates: int
    """frames that came a second time, and were dropped"""
    late: int
    """frames that others had overtaken, and that were dropped; the lost frames include them"""
    skipped: int
    """frames that the estimator has not seen, since they came faster than they could be converted"""
    unsolved: int
    """frames whose readings no cell resistances can give; many of them mean that the design is not that of the board"""
    not_valid: dict[str, int]
    """cells of the newest converted frame that are not valid, by the name of their :class:`ohmskin.circuits.Reason`"""
    remark: str | None
    """why hardly any cell was valid in the first frames; that the board's clock is none; which lines are faulty; why
    there are no pressures, or that one should tare"""
    rate_hz: float
    """frames per second of the board's time, over the last 1000 frames; NaN before the second frame"""
    age_s: dict[int, float]
    """percentile -> age of the newest frame when it was taken, over the last 1000 taken; NaN before the first"""
    jitter_s: dict[int, float]
    """percentile -> delay of a frame beyond the least delay seen, over the last 1000; NaN without device time"""
    drift_ppm: float
    """how much faster the host's clock runs than the board's, in parts per million; 0 until 5 s of even pace have
    passed, and without device time; NaN if the board's time is no clock's (it stands, or they differ by more than an
    eighth, as at an emulator's fast clock): frames then have the times at which they came"""
    clock_steps: int
    """number of times that the board's clock was set or paused while it ran"""

    def as_dict(self) -> dict[str, object]:
        """The fields by name."""
        return asdict(self)


@dataclass
class Counters:
    """Numbers kept by the reader thread and the consumers. Every number has one writer."""

    frames: int = 0
    lost: int | None = 0
    overruns: int = 0
    corrupt: int = 0
    why_corrupt: str = ""
    resyncs: int = 0
    reconnects: int = 0
    reboots: int = 0
    duplicates: int = 0
    late: int = 0
    clock_steps: int = 0
    """of the clock maps before the present one"""
    unsolved: int = 0
    reasons: NDArray[np.int8] | None = None
    """of the newest converted frame, a :class:`ohmskin.circuits.Reason` for each cell"""
    remark: str | None = None
    """why no cell is valid"""
    clock: str | None = None
    """why the board's time is not used"""
    faulty: str | None = None
    """names lines whose readings no load explains"""
    untared: str | None = None
    """why the skin should be tared"""
    notices: deque[str] = field(default_factory=deque)
    """warnings for the next reader who takes a frame"""
    times_s: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT_FRAMES))
    """of the last frames, on the time scale of the estimator"""
    ages_s: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT_FRAMES))
    delays_s: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT_FRAMES))

    def snapshot(self, *, skipped: int, drift_ppm: float, clock_steps: int) -> LinkStatistics:
        """The numbers as they are now; ``skipped`` frames were not converted."""
        times = list(self.times_s)
        elapsed = times[-1] - times[0] if len(times) > 1 else 0.0
        stated = {item.name for item in fields(LinkStatistics)}
        counts: dict[str, Any] = {item.name: getattr(self, item.name) for item in fields(self) if item.name in stated}
        return LinkStatistics(
            **counts
            | {
                "skipped": skipped,
                "not_valid": _not_valid(self.reasons),
                "remark": "; ".join(filter(None, (self.remark, self.clock, self.faulty or self.untared))) or None,
                "rate_hz": (len(times) - 1) / elapsed if elapsed > 0 else float("nan"),
                "age_s": _percentiles(self.ages_s),
                "jitter_s": _percentiles(self.delays_s),
                "drift_ppm": drift_ppm,
                "clock_steps": self.clock_steps + clock_steps,
            }
        )


def _not_valid(reasons: NDArray[np.int8] | None) -> dict[str, int]:
    if reasons is None:
        return {}
    return {
        Reason(value).name.lower(): int(cells)
        for value, cells in zip(*np.unique(reasons, return_counts=True), strict=True)
        if value not in (Reason.VALID, Reason.NO_CELL)
    }


def _percentiles(values: deque[float]) -> dict[int, float]:
    sample = list(values)
    if not sample:
        return dict.fromkeys(PERCENTS, float("nan"))
    return dict(zip(PERCENTS, np.percentile(sample, PERCENTS).tolist(), strict=True))
