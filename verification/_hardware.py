"""Quantities measured on a board: an emulated one, the firmware, or one behind a port."""

from __future__ import annotations

from ..circuits import Requirement
from ._outcome import Measurement, NotRun
from ._subject import Subject


def measured_on_board(subject: Subject, requirement: Requirement) -> Measurement:
    """One quantity of the catalogue, measured on the target of this run."""
    raise NotRun("no board: --target PORT names one")
