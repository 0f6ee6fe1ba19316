"""Calibration protocol (experiment design): a sequence of presses that determines the parameters of a cell quickly.

The Cramer-Rao bound of the sequence below is 3-4 % for each of the time constants 2, 20 and 120 s. The hold at an
intermediate level determines the static curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import InputError
from ._recording import Recording


@dataclass(frozen=True)
class Step:
    """One step of the protocol: hold a level, or ramp to it."""

    level: float
    """fraction of full scale"""
    seconds: float
    ramp: bool = False

    def __str__(self) -> str:
        what = "no load" if self.level == 0 else f"{100 * self.level:.0f} % of full scale"
        return f"{'go steadily to' if self.ramp else 'hold'} {what} for {self.seconds:g} s"


CONDITIONING = (Step(0.0, 2.0), Step(1.0, 10.0), Step(0.0, 20.0))
"""first steps: a rest that determines R0, then a press, which raises R0 of a fresh cell by several percent"""
PROTOCOL = (
    Step(0.5, 20.0),
    Step(0.0, 20.0),
    Step(1.0, 20.0),
    Step(0.0, 20.0),
    Step(1.0, 10.0, ramp=True),
    Step(0.0, 10.0, ramp=True),
    Step(0.0, 20.0),
    Step(1.0, 60.0),
    Step(0.0, 60.0),
)
TOLERANCE = 0.15
"""accepted deviation from a level, over full scale"""
ENOUGH = 0.7
"""least duration of a hold, over the requested one"""


def protocol_text() -> str:
    """The protocol as a numbered list for the person who presses."""
    steps = [*CONDITIONING, *PROTOCOL]
    lines = [f"{n:2d}. {step}" for n, step in enumerate(steps, 1)]
    lines.insert(len(CONDITIONING), "    (conditioned; keep recording)")
    seconds = sum(step.seconds for step in steps)
    return "\n".join(
        [f"Press the cell as follows and record it all, {seconds:.0f} s and about one second per change:", *lines]
    )


def protocol_load(dt_s: float) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], ...]:
    """Times (n,) and normalised loads (n,) of the protocol with conditioning, every ``dt_s``; changes take 1 s."""
    times, levels = [0.0], [0.0]
    for step in (*CONDITIONING, *PROTOCOL):
        change = step.seconds if step.ramp else 1.0 if step.level != levels[-1] else 0.0
        times += [times[-1] + change] + ([] if step.ramp else [times[-1] + change + step.seconds])
        levels += [step.level] * (1 if step.ramp else 2)
    at = np.arange(0, times[-1], dt_s)
    return at, np.interp(at, times, levels)


def check_protocol(recording: Recording, full_scale_kpa: float | None = None) -> list[str]:
    """One line for every step of the protocol, with its time in the recording.

    Without ``full_scale_kpa``, the 95 % quantile of the pressure counts as full scale.

    Raises:
        InputError: a step is missing; the message names the step and the time at which it was expected.
    """
    time = recording.time_s
    pressed = recording.quiet.pressure_kpa
    pressed = pressed / (float(np.quantile(pressed, 0.95)) if full_scale_kpa is None else full_scale_kpa)
    cursor, found = time[0], []
    for number, step in enumerate((*CONDITIONING, *PROTOCOL), 1):
        if step.ramp:
            found.append(f"{number:2d}. {step}: between the holds")
            continue
        within = np.abs(pressed - step.level) <= TOLERANCE
        edges = np.flatnonzero(np.diff(within.astype(int), prepend=0, append=0))
        holds = [
            (max(time[a], cursor), time[b - 1])
            for a, b in zip(edges[::2], edges[1::2], strict=True)
            if time[b - 1] - max(time[a], cursor) >= ENOUGH * step.seconds
        ]
        if not holds:
            raise InputError(
                f"{recording.name}: step {number} of the protocol is missing: {step}, expected after {cursor:.0f} s"
            )
        start, end = holds[0]
        found.append(f"{number:2d}. {step}: from {start:.0f} s")
        cursor = min(end, start + step.seconds)
    return found
