"""The families of boards, one module each. A new family is one more module here and one line in ``BOARDS``."""

from collections.abc import Mapping

from .._protocol import Family
from ._actionsense import ACTIONSENSE
from ._capstone import CAPSTONE
from ._flexitac import FLEXITAC
from ._fsr_array import FSR_ARRAY
from ._m1616 import M1616
from ._ohmskin import OHMSKIN
from ._snowboard import SNOWBOARD
from ._vitac import VITAC
from ._wiresens import WIRESENS

_FAMILIES = (OHMSKIN, WIRESENS, FLEXITAC, VITAC, ACTIONSENSE, FSR_ARRAY, CAPSTONE, M1616, SNOWBOARD)

BOARDS: Mapping[str, Family] = {family.name: family for family in _FAMILIES}
"""families by name"""

__all__ = ["BOARDS"]
