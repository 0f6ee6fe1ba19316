"""Hardware in the loop: tests of skins and programs that run against an emulated board, its firmware, or a real one.

:mod:`ohmskin.hil.plugin` is the plugin of pytest. This face has what the plugin's fixtures hand out, and
:func:`write_suite`, which copies an example suite.
"""

from ._board import BoardInService, TargetMissing, serve
from ._cells import described
from ._press import Load, Press
from ._suite import write_suite

__all__ = ["BoardInService", "Load", "Press", "TargetMissing", "described", "serve", "write_suite"]
