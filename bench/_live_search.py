"""Search for wrong live readings: quantised streams of random boards of every circuit, against the cells behind them.

``python -m ohmskin.bench.search --live``. :mod:`._live_streams` makes each stream from a family's name and a number;
the driver's :class:`.CountReader` takes the counts. Findings:

* a *wrong cell*: valid, and off by more than its uncertainty (with noise: by five standard deviations, since an
  uncertainty covers three and a search sees millions of readings);
* a *factor of two*: such a cell, and off by more than that, as any valid resistance of an open cell is;
* an *unsolved* frame: right readings for which no cells are found;
* an *unsettled* stream: cells are still called unsettled in the last of eight equal frames.

Nobody can know of a noise before it is in four readings that are not at a limit, and of two frames nobody can say
whether noise or a press has changed them. Cells that are off in the first two frames of a noise larger than the reader
assumes or has seen for some frames are counted as *surprised* and are no findings, as long as a reader that knows the
noise has none in that frame. For the same reason noise may carry a cell beyond a factor of two within five standard
deviations: of the readings of a cell whose uncertainty just suffices, 3 in 1000 are beyond three.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..circuits import Reason
from ..common.arrays import FloatArray
from ..driver import CountReader, Measurement
from ._live_streams import LiveStream, stream
from .harness import column

_LEAST_SHOWN = 4  # readings that have shown a noise before a reader can know of it
_LASTED = 4  # frames of a noise that is past, of which a reader can know that it was one and no press
_ASSUMED_NOISE = 0.5  # ADC steps that the reader assumes in the first frame


@dataclass
class LiveTally:
    """What was found in one family."""

    family: str = field(default="", metadata=column("family", "{}", width=20))
    boards: int = field(default=0, metadata=column("boards", "{}", width=7))
    unreadable: int = field(default=0, metadata=column("unread", "{}"))
    """boards that cannot be read, so that no stream was made"""
    frames: int = field(default=0, metadata=column("frames", "{}", width=7))
    valid: int = field(default=0, metadata=column("valid", "{}", width=8))
    """cells"""
    cells: int = field(default=0, metadata=column("of cells", "{}"))
    used: float = field(default=0.0, metadata=column("used", "{:.2g}", width=6))
    """largest error over its uncertainty, streams without noise"""
    surprised: int = field(default=0, metadata=column("surprised", "{}"))
    """frames with wrong cells that no reader could know to be wrong"""
    findings: list[str] = field(default_factory=list, metadata=column("findings", "{}"))

    def count(self, what: str) -> int:
        """Findings of one kind."""
        return sum(finding.startswith(what) for finding in self.findings)


def check(family: str, number: int, tally: LiveTally) -> None:
    """Draw one stream, read it and compare."""
    read_from = stream(family, number)
    if read_from is None:
        tally.boards += 1
        tally.unreadable += 1
    else:
        compare(f"{family}:{number}", read_from, tally)


def compare(name: str, read_from: LiveStream, tally: LiveTally) -> None:
    """Read one stream and compare."""
    tally.boards += 1
    found: dict[str, str] = {}
    reader = CountReader(read_from.design)
    free: list[int] = []
    reading = None
    for frame, counts in enumerate(read_from.counts):
        reading = reader(counts)
        tally.frames += 1
        tally.valid, tally.cells = tally.valid + int(reading.valid.sum()), tally.cells + counts.size
        if (reading.reason == Reason.UNSOLVED).all():
            found.setdefault("unsolved", f"frame {frame}")
        wrong = _wrong_cells(reading, read_from, frame, tally)
        free.append(int((reading.reason != Reason.SATURATED).sum()))
        known = _known_noise(read_from.noise_steps[: max(frame - 1, 0)], free)
        noise = float(read_from.noise_steps[frame])
        if wrong and noise > known and not _wrong_cells(_informed(read_from, frame), read_from, frame, LiveTally()):
            tally.surprised += 1
        else:
            found |= wrong
    if reading is not None and (reading.reason == Reason.UNSETTLED).any() and not read_from.noisy:
        found["unsettled"] = "in the last frame"
    tally.findings += [f"{what}: {name}, {where}" for what, where in found.items()]


def _informed(read_from: LiveStream, frame: int) -> Measurement:
    """What a reader that knows the noise makes of one frame."""
    reader = CountReader(read_from.design)
    reader.remember(float(read_from.noise_steps[frame]), read_from.counts[frame - 1] if frame else None)
    return reader(read_from.counts[frame])


def _wrong_cells(reading: Measurement, read_from: LiveStream, frame: int, tally: LiveTally) -> dict[str, str]:
    """The findings in the valid cells of one frame."""
    valid, found = reading.valid, {}
    if not valid.any():
        return {}
    # Shares of true conductances in those that were read. That of an open cell is 0.
    share = reading.resistance[valid] / read_from.cells[frame][valid]
    used = float((np.abs(share - 1.0) / reading.uncertainty[valid]).max())
    if not read_from.noisy:
        tally.used = max(tally.used, used)
    if used > (5.0 / 3.0 if read_from.noisy else 1.0 + 1e-9):
        found["wrong cell"] = f"frame {frame}, error {used:.2f} uncertainties"
        if share.min() < 0.5 or share.max() > 2.0:
            found["factor of two"] = f"frame {frame}"
    return found


def _known_noise(noise_steps: FloatArray, free: list[int]) -> float:
    """ADC steps, the largest noise that a reader can know after some frames.

    Args:
        noise_steps: (frames,) of these frames.
        free: readings of each frame that are not at a limit, where they would not show a noise.

    """
    known = _ASSUMED_NOISE
    for noise in noise_steps:
        if noise_steps[-1] < noise and np.count_nonzero(noise_steps >= noise) < _LASTED:
            continue
        if sum(count for count, each in zip(free, noise_steps, strict=False) if each >= noise) >= _LEAST_SHOWN:
            known = max(known, float(noise))
    return known
