"""Firmware in the loop: the reference board's program, executed instruction by instruction.

``firmware/`` has the program, ``docs/hardware.md`` the board. The emulated processor is avr8js, a process of Node.js::

    with FirmwareBoard(Scene.load("scene.toml")) as board:
        data = board.run(0.5)  # the bytes that the board sends in half a second of its own time
"""

from ._board import REFERENCE_BOARDS, BoardKind, BoardSettings, FirmwareBoard, check_scene
from ._circuit import REFERENCE_RESISTORS_OHM, reference_outputs
from ._engines import AVR8JS, Engine, missing_for
from ._loop import FirmwareInService
from ._measure import (
    BAUD_RATES,
    ERROR_BUDGET_STEPS,
    PRESCALERS_LOG2,
    DwellError,
    FrameRate,
    dwell_error,
    fastest_scan,
    line_rate,
)
from ._processor import CLOCK_HZ, Processor

__all__ = [
    "AVR8JS",
    "BAUD_RATES",
    "CLOCK_HZ",
    "ERROR_BUDGET_STEPS",
    "PRESCALERS_LOG2",
    "REFERENCE_BOARDS",
    "REFERENCE_RESISTORS_OHM",
    "BoardKind",
    "BoardSettings",
    "DwellError",
    "Engine",
    "FirmwareBoard",
    "FirmwareInService",
    "FrameRate",
    "Processor",
    "check_scene",
    "dwell_error",
    "fastest_scan",
    "line_rate",
    "missing_for",
    "reference_outputs",
]
