"""The board under test: an emulated one, an emulated processor that runs the firmware, or a real one at a port."""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..emulator import EngineName, Hand, PtyPort, Scene, running
from ..emulator.firmware import missing_for
from ..errors import OhmskinError

EMULATED, FIRMWARE = "emulated", "firmware"


class TargetMissing(OhmskinError):
    """The board under test is not there; the message says why. Such tests are "not run"."""


@dataclass(frozen=True)
class BoardInService:
    """A board that can be opened."""

    target: str
    """"emulated", "firmware", or the name of a real board's port"""
    port: str
    """what a host opens"""
    family: str
    """of its protocol, as in ``Skin.open(port, board=family)``"""
    hand: Hand | None
    """presses on the skin; None: a person must"""

    @property
    def is_hardware(self) -> bool:
        """Whether the board is a real one."""
        return self.target not in (EMULATED, FIRMWARE)


@contextmanager
def serve(
    target: str, *, family: str = "ohmskin", scene: Path | None = None, seed: int = 0
) -> Iterator[BoardInService]:
    """A board in service for the time of the block.

    Args:
        target: "emulated", "firmware", or the port of a real board.
        family: of the board's protocol.
        scene: SCENE.toml of the emulated skin; None: the scene of the example suite.
        seed: of the emulated noise.

    Raises:
        TargetMissing: this machine cannot run the firmware.
        InputError: the scene is not valid.

    """
    if target not in (EMULATED, FIRMWARE):
        yield BoardInService(target, target, family, None)
        return
    engine: EngineName = "firmware" if target == FIRMWARE else "model"
    if engine == "firmware" and (reason := missing_for()) is not None:
        raise TargetMissing(reason)
    described = _scene(scene)
    port = PtyPort()
    hand = Hand(described.skin.design.array.shape)
    with running(described, port, seed=seed, family=family, engine=engine, hand=hand):
        yield BoardInService(target, port.name, family, hand)


def _scene(path: Path | None) -> Scene:
    if path is not None:
        return Scene.load(path)
    with importlib.resources.as_file(importlib.resources.files(__package__) / "suite") as folder:
        return Scene.load(folder / "scene.toml")
