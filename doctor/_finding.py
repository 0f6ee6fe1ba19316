"""One line of the diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """How a finding is to be taken."""

    OK = "ok"
    OPTIONAL = "optional"
    """something is missing that only some commands need"""
    PROBLEM = "problem"
    """something will not work, or will work badly"""


@dataclass(frozen=True)
class Finding:
    """What was looked at, what was found, and how to mend it."""

    state: State
    subject: str
    found: str
    mend: str = ""
    """what to type, or to do; empty where nothing needs mending"""
