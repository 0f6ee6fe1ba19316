"""Streams of readings that the live recovery once misread, kept in ``data/misread_streams.npz``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ohmskin.bench._live_streams import LiveStream
from ohmskin.circuits import Design

_FILE = np.load(Path(__file__).parent / "data" / "misread_streams.npz")
_HEADS = json.loads(str(_FILE["heads"]))
NAMES: list[str] = [head["name"] for head in _HEADS]


def stream(name: str) -> LiveStream:
    """One of them. The last cells in the file are those of all later frames."""
    number = NAMES.index(name)
    cells, counts, noise = (_FILE[f"{what}{number}"] for what in ("cells", "counts", "noise"))
    held = np.repeat(cells[-1:], len(counts) - len(cells), axis=0)
    design = Design.model_validate(_HEADS[number]["design"])
    return LiveStream(design, np.concatenate([cells, held]).astype(float), noise, list(counts))
