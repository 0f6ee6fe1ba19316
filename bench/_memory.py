"""``python -m ohmskin.bench._memory METHOD SIZE SEGMENT``: the memory that one frame takes at its peak, in bytes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from ..circuits import METHODS, scan
from ._measurement import board, cells
from ._peers import PEERS


def main(name: str, size: int, segment: float) -> None:
    """Print it as JSON; null where the system does not tell."""
    peers = {peer.name: peer for peer in PEERS}

    def solve(side: int) -> None:
        design, frame = board(side, segment), cells(side)[0]
        if name in METHODS:
            scan(design, frame, method=name)
        else:
            peers[name].solve(design, frame)

    solve(4)  # imports and caches are not the frame's
    before = _peak()
    solve(size)
    after = _peak()
    print(json.dumps(None if before is None or after is None else after - before))


def _peak() -> int | None:
    """Bytes of resident memory at this process's peak so far (Linux)."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:")), None)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
