"""Firmware in the loop: the reference board's program, executed instruction by instruction.

``firmware/`` has the program, ``docs/hardware.md`` the board. The emulated processor is avr8js, a process of Node.js::

    with FirmwareBoard(Scene.load("scene.toml")) as board:
        data = board.run(0.5)  # the bytes that the board sends in half a second of its own time
"""

from ._board import REFERENCE_BOARDS, BoardKind, BoardSettings, FirmwareBoard, check_scene
from ._circuit import REFERENCE_RESISTORS_OHM, reference_outputs
from ._engines import AVR8JS, Engine, missing_for
from ._loop import FirmwareInService
from ._measure import ERROR_BUDGET_STEPS, DwellError, dwell_error
from ._processor import Processor

__all__ = [
    "AVR8JS",
    "ERROR_BUDGET_STEPS",
    "REFERENCE_BOARDS",
    "REFERENCE_RESISTORS_OHM",
    "BoardKind",
    "BoardSettings",
    "DwellError",
    "Engine",
    "FirmwareBoard",
    "FirmwareInService",
    "Processor",
    "check_scene",
    "dwell_error",
    "missing_for",
    "reference_outputs",
]
