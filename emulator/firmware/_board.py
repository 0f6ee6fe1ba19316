"""A reference board in the loop: emulated processor, wiring, circuit and skin as one object with a serial line.

Time passes only in :meth:`FirmwareBoard.run`, so that the same calls give the same bytes on any machine.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from ...circuits import adc_codes
from ...common.arrays import FloatArray
from ...errors import InputError
from ...wire import FramePacket, Identity, PacketDecoder, encode
from .._hand import Hand
from .._line_settings import BYTE_FAULTS, PACKET_FAULTS, ClockSettings
from .._scene import Scene
from .._skin import Sample
from ._circuit import ScanCircuit
from ._engines import AVR8JS, Engine
from ._processor import CLOCK_HZ, Processor
from ._wiring import DirectWiring, ShiftedWiring, Wiring

_HERE = Path(__file__).parent
_LINK_FAULTS = (*BYTE_FAULTS, *PACKET_FAULTS, "stall", "split-bytes", "second-host")
_FIRST_ROW = frozenset({0})
_ADC_BITS = 10
_STORED = struct.Struct("<BBBxHxxI16s")  # the settings in EEPROM, see docs/hardware.md
_MAGIC = 0x5A
DEFAULT_BAUD = 1_000_000
"""bit/s of a board with an erased EEPROM"""
_FASTEST_BAUD = 2_000_000  # 16 MHz / 8
_BOOTS = struct.Struct("<I")
_BOOTS_ADDRESS = 32


@dataclass(frozen=True)
class BoardKind:
    """One of the boards that there is a firmware for."""

    name: str
    hex_file: Path
    wiring: Callable[[], Wiring]
    adc_prescaler_log2: int
    dwell_us: int
    """us from selecting a row to its first conversion, unless the settings say otherwise"""


REFERENCE_BOARDS = (
    BoardKind("4x4", _HERE / "ohmskin-4x4.hex", DirectWiring, 7, 140),
    BoardKind("16x16", _HERE / "ohmskin-16x16.hex", ShiftedWiring, 5, 75),
)
"""boards of docs/hardware.md"""


def check_scene(scene: Scene) -> BoardKind:
    """The board whose firmware can scan a scene's array.

    Raises:
        InputError: there is none of that size, the scene's converter is not that of the chip, or the scene asks for
            something that only the model of a board does.

    """
    for number, fault in enumerate(scene.link_fault):
        if fault.kind not in _LINK_FAULTS:
            kinds = ", ".join(_LINK_FAULTS)
            raise InputError(f'link_fault[{number}]: "{fault.kind}"; the firmware engine has {kinds}')
    if scene.clock != ClockSettings():
        raise InputError("clock: the firmware engine has the exact clock of its processor; leave the table out")
    if scene.line.auto_reset:
        raise InputError("line.auto_reset: the firmware engine has no such part; leave the key out")
    design = scene.skin.design
    rows, columns = design.array.shape
    for kind in REFERENCE_BOARDS:
        wiring = kind.wiring()
        if (wiring.rows, wiring.columns) == (rows, columns):
            break
    else:
        sizes = " and ".join(kind.name for kind in REFERENCE_BOARDS)
        raise InputError(f"skin.design.array: {rows} x {columns} cells; the firmware is built for {sizes}")
    assert design.adc is not None  # a scene is refused without one
    if design.adc.bits != _ADC_BITS or design.adc.range[0] != 0.0:
        raise InputError(
            f"skin.design.adc: {design.adc.bits} bits from {design.adc.range[0]} V; "
            f"the chip that runs the firmware converts {_ADC_BITS} bits from 0 V"
        )
    if design.readout.circuit != "inverting-amplifier":
        raise InputError(
            f'skin.design.readout.circuit: "{design.readout.circuit}"; the firmware\'s board has "inverting-amplifier"'
        )
    return kind


@dataclass(frozen=True)
class BoardSettings:
    """What a board keeps in its EEPROM."""

    period_us: int = 20_000
    """us between two frames at power-up"""
    dwell_us: int | None = None
    """us from selecting a row to its first conversion; None: as the board needs it"""
    baud: int = DEFAULT_BAUD
    adc_prescaler_log2: int | None = None
    """ADC clock = 16 MHz / 2**this, 4 to 7; None: as the board needs it"""
    serial_number: str = "UNNAMED"

    def eeprom(self, kind: BoardKind, boots: int = 0) -> bytes:
        """Contents of the EEPROM from address 0; what follows is erased.

        Args:
            kind: the board.
            boots: number that the next start gets as its boot id.

        Raises:
            InputError: a value that the EEPROM or the chip cannot hold.

        """
        divider = round(_FASTEST_BAUD / self.baud) if self.baud > 0 else 0
        if not 1 <= divider <= 256 or abs(_FASTEST_BAUD / divider / self.baud - 1) > 0.025:
            raise InputError(f"baud rate {self.baud}; expected 2 000 000 divided by 1 ... 256, within 2.5 %")
        text = self.serial_number.encode()
        if len(text) > 15 or b"\0" in text:
            raise InputError(f"serial number '{self.serial_number}'; expected at most 15 bytes")
        prescaler = kind.adc_prescaler_log2 if self.adc_prescaler_log2 is None else self.adc_prescaler_log2
        dwell = kind.dwell_us if self.dwell_us is None else self.dwell_us
        if not 4 <= prescaler <= 7 or not 0 <= dwell <= 30_000 or not 0 < self.period_us < 2**32:
            raise InputError(
                f"ADC prescaler 2^{prescaler}, dwell {dwell} us, period {self.period_us} us; "
                "expected 2^4 ... 2^7, 0 ... 30000 us and a period above 0"
            )
        stored = _STORED.pack(_MAGIC, divider - 1, prescaler, dwell, self.period_us, text)
        return stored.ljust(_BOOTS_ADDRESS, b"\xff") + _BOOTS.pack((boots - 1) % 2**32)


class FirmwareBoard:
    """A reference board that scans ``scene`` with its own firmware, executed instruction by instruction.

    The board describes itself by the design that its firmware was built for (``examples/board-*.toml``). The circuit
    around it is that of the scene, whose parts may differ, as those of a real board do.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        settings: BoardSettings | None = None,
        engine: Engine = AVR8JS,
        hex_file: Path | None = None,
        seed: int = 0,
        boot_id: int = 1,
        hand: Hand | None = None,
        record: Callable[[Sample], None] | None = None,
    ) -> None:
        """Switch the board on.

        Args:
            scene: skin, circuit and contacts.
            settings: contents of the EEPROM; None: the scene's frame rate and serial number.
            engine: emulator of the processor.
            hex_file: another program than the one that ohmskin brings, for the same wiring.
            seed: for the noise at the ADC.
            boot_id: number of this start.
            hand: presses beside the scene's contacts.
            record: called with every frame that arrived at the serial line, as it truly was; volts are those converted.

        Raises:
            InputError: no firmware fits the scene, or a setting is out of range.
            MissingExtra: the engine cannot run here.

        """
        self.scene = scene
        self.kind = check_scene(scene)
        if settings is None:
            settings = BoardSettings(
                period_us=round(1e6 / scene.board.frame_rate),
                baud=scene.line.baud_rate or DEFAULT_BAUD,
                serial_number=scene.board.serial_number[:15],
            )
        self.settings = settings
        self.clear_to_send = True
        """handshake line of the serial port: False stops the board from sending"""
        self.resets = 0
        """times that the watchdog has reset the chip"""
        self.conversions_hang = False
        """a fault: conversions that begin from now on never end"""
        self._circuit = ScanCircuit(scene, seed, hand)
        self._wiring = self.kind.wiring()
        self._rows: frozenset[int] = frozenset()
        self._observer = _FrameObserver(self._circuit, scene, record)
        self._identity: Identity | None = None
        self._next_sequence = 0
        self._decoder = PacketDecoder()
        self._arriving = b""
        eeprom = settings.eeprom(self.kind, boot_id)
        program = self.kind.hex_file if hex_file is None else hex_file
        self._processor = Processor(engine, program, eeprom, self)

    @property
    def time_s(self) -> float:
        """S since power-up."""
        return self._processor.cycle / CLOCK_HZ

    @property
    def sample_instants(self) -> list[tuple[float, int, int]]:
        """(s, row, column) of each sample instant of the latest whole frame; for measurements of timing."""
        return self._observer.instants

    @property
    def row_switches(self) -> list[tuple[float, int]]:
        """(s, row) of each row selection of the latest whole frame."""
        return self._observer.switches

    def prepare(self) -> None:
        """Make ready, before a host may come, what would keep a first press waiting."""
        self._circuit.prepare()

    def send(self, data: bytes) -> None:
        """Bytes of the host; they arrive one after the other at the speed of the line, from the next run on."""
        self._arriving += data

    def run(self, seconds: float) -> bytes:
        """Let time pass for the board; the bytes that it sends meanwhile.

        Raises:
            LinkError: the emulated processor ended or hangs.

        """
        received, self._arriving = self._arriving[:0xFFFF], self._arriving[0xFFFF:]
        until = self._processor.cycle + max(1, round(seconds * CLOCK_HZ))
        sent = self._processor.run(until, received, clear_to_send=self.clear_to_send)
        for event in self._decoder.feed(sent):
            if isinstance(event, Identity):
                self._identity = event
            elif isinstance(event, FramePacket):
                assert event.sequence is not None
                self._next_sequence = (event.sequence + 1) % 2**32
                self._observer.sent(event)
        return sent

    def farewell(self) -> bytes:
        """The packet that says that no frame follows, in place of the firmware; empty before it has named itself."""
        known = self._identity
        if known is None:
            return b""
        time_us = round(1e6 * self.time_s)
        return encode(replace(known, sequence=self._next_sequence, time_us=time_us, streaming=False, over=True))

    def hold_cells(self, resistance: FloatArray) -> None:
        """Cells of these resistances from now on, (rows, columns) ohm, instead of those of the scene."""
        self._circuit.hold_cells(resistance)

    def close(self) -> None:
        """Switch the board off."""
        self._processor.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def port_written(self, cycle: float, port: str, output: int, direction: int) -> None:
        """For the processor: see :class:`._processor.Surroundings`."""
        self._wiring.port_written(port, output, direction)
        self._select(cycle, self._wiring.selected())

    def conversion_started(self, cycle: float, channel: int) -> None:
        """For the processor."""
        column = self._wiring.column(channel)
        if column is not None:
            self._circuit.connect(cycle / CLOCK_HZ, column)

    def conversion_sampled(self, cycle: float, channel: int) -> float | None:
        """For the processor."""
        if self.conversions_hang:
            return None
        column = self._wiring.column(channel)
        assert self.scene.skin.design.adc is not None
        reference = self.scene.skin.design.adc.range[1]
        if column is None:  # an open input: nothing that a program could rely on
            return 0.0
        volts = self._circuit.sample(cycle / CLOCK_HZ)
        self._observer.sampled(cycle / CLOCK_HZ, column, volts)
        return self._circuit.code_volts(volts) / reference

    def chip_reset(self, cycle: float) -> None:
        """For the processor."""
        self.resets += 1
        self.conversions_hang = False
        self._wiring = self.kind.wiring()
        self._observer.forget()
        self._select(cycle, frozenset())

    def _select(self, cycle: float, rows: frozenset[int]) -> None:
        if rows != self._rows:
            self._rows = rows
            self._circuit.select(cycle / CLOCK_HZ, rows)
            self._observer.selected(cycle / CLOCK_HZ, rows)


class _FrameObserver:
    """Tells which conversions make a frame, and matches them with the frames that the board sends."""

    def __init__(self, circuit: ScanCircuit, scene: Scene, record: Callable[[Sample], None] | None) -> None:
        self._circuit = circuit
        self._scene = scene
        self._record = record
        self._row: int | None = None
        self._rowless = 0
        """conversions since a row was selected: a self-test makes one per column"""
        self._volts: FloatArray = np.full(scene.skin.design.array.shape, np.nan)
        self._began: tuple[FloatArray, FloatArray] | None = None
        self._frames: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque(maxlen=16)
        self._instants: list[tuple[float, int, int]] = []
        self._switches: list[tuple[float, int]] = []
        self.instants: list[tuple[float, int, int]] = []
        self.switches: list[tuple[float, int]] = []

    def forget(self) -> None:
        """The chip was reset: what it had scanned is lost."""
        self._frames.clear()
        self._began = None

    def selected(self, time_s: float, rows: frozenset[int]) -> None:
        """Other rows are selected. A frame begins with row 0, and with nothing converted before it."""
        self._row = next(iter(rows)) if len(rows) == 1 else None
        if rows == _FIRST_ROW and self._rowless < 2:  # the first conversion after power-up is a single one
            self._began = (self._circuit.pressure_kpa, self._circuit.resistance_ohm)
            self._volts = np.full_like(self._volts, np.nan)
            self._instants, self._switches = [], []
        if self._row is not None:
            self._rowless = 0
            self._switches.append((time_s, self._row))

    def sampled(self, time_s: float, column: int, volts: float) -> None:
        """One conversion. A self-test also reads with no row selected, and is no frame."""
        if self._row is None:
            self._rowless += 1
            return
        if self._began is None or self._row >= len(self._volts):
            return
        self._volts[self._row, column] = volts
        self._instants.append((time_s, self._row, column))
        if not np.isnan(self._volts).any():
            pressure, resistance = self._began
            self._frames.append((pressure, resistance, self._volts))
            self.instants, self.switches = self._instants, self._switches
            self._began = None

    def sent(self, frame: FramePacket) -> None:
        """A frame left the board: match it with what was converted for it."""
        if self._record is None or not self._frames:
            return
        assert frame.sequence is not None
        assert frame.time_us is not None
        pressure, resistance, volts = self._frames.popleft()
        codes = adc_codes(self._scene.skin.design, volts)
        self._record(Sample(frame.sequence, frame.time_us / 1e6, pressure, resistance, volts, codes))
