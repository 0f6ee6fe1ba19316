"""Print what the firmware in the loop measures: ``python -m ohmskin.emulator.firmware EXAMPLES [4x4 | 16x16]``."""

from __future__ import annotations

import sys
from pathlib import Path

from ._board import REFERENCE_BOARDS
from ._measure import tables

if __name__ == "__main__":
    folder, *names = sys.argv[1:] or ["examples"]
    for line in tables([kind for kind in REFERENCE_BOARDS if not names or kind.name in names], Path(folder)):
        print(line, flush=True)
