"""Speed of the live path beside that of another checkout, in turn: ``python tests/beside.py CHECKOUT [SIZE ...]``.

``git worktree add CHECKOUT COMMIT`` makes one. Frames per second of processor time of a reader who takes every frame
with its standard deviations, under five fingers; the slowest frame after the 400th in medians.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

FRAMES, SKIPPED, TURNS = 700, 400, 2
PROGRAM = """
import gc, json, sys, time, warnings
import numpy as np
from ohmskin.bench import _driver as live
from ohmskin.cell import Cell
warnings.simplefilter("ignore")
circuit, size, frames, skipped = sys.argv[1], *map(int, sys.argv[2:])
board = live.design(size, circuit, "ground", 12 if circuit.endswith("amplifier") else 10)
_, cells = live.pressed(board.array.shape, frames)
port = live.PacedPort(live.packets_of(board, cells), (1.0 - 1e-9) / 200.0, board, clock=float)
spent = np.empty(frames)
with live.every_frame(port, board, Cell.example(), None) as skin:
    gc.collect()
    gc.freeze()
    for frame in range(frames):
        port.work(1.0 / 200.0)
        start = time.process_time()
        skin.read(0.0).pressure_std
        spent[frame] = time.process_time() - start
late = spent[skipped:]
print(json.dumps([1.0 / late.mean(), late.max() / np.median(late)]))
"""


def measured(checkout: Path, circuit: str, size: int) -> tuple[float, float]:
    """Frames per second of processor time, and the slowest frame over the median."""
    numbers = [circuit, *map(str, (size, FRAMES, SKIPPED))]
    environment = os.environ | {"PYTHONPATH": str(checkout / "src"), "OPENBLAS_NUM_THREADS": "1"}
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM, *numbers], env=environment, cwd=checkout, capture_output=True, check=True
    )
    rate, worst = json.loads(found.stdout)
    return rate, worst


def main() -> None:
    """Print a row for each board."""
    here, other = Path(__file__).parents[1], Path(sys.argv[1])
    print("circuit             cells     frames/s  there  ratio  slowest frame, medians")
    for circuit in ("inverting-amplifier", "voltage-divider"):
        for size in map(int, sys.argv[2:] or ("8", "16")):
            turns = [(measured(here, circuit, size), measured(other, circuit, size)) for _ in range(TURNS)]
            (own, worst), (there, _) = (max(side) for side in zip(*turns, strict=True))
            print(f"{circuit:19} {size:2} x {size:2} {own:10.0f} {there:6.0f} {own / there:6.2f} {worst:10.1f}")


if __name__ == "__main__":
    main()
