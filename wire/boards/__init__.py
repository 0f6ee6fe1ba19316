"""The families of boards, one module each. A new family is one more module here and one line in ``BOARDS``."""

from collections.abc import Mapping

from .._protocol import Family
from ._ohmskin import OHMSKIN

BOARDS: Mapping[str, Family] = {family.name: family for family in (OHMSKIN,)}
"""families by name"""

__all__ = ["BOARDS"]
