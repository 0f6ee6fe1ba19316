"""Co-simulation in lock-step: the emulated processor runs until it needs the circuit, and waits while that answers."""

from __future__ import annotations

import os
import select
import struct
import subprocess
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, Self

from ...errors import LinkError
from .._tuning import DRAIN_S
from ._engines import Engine

CLOCK_HZ = 16_000_000
"""CPU cycles per second: the board's quartz"""

_RECORD = struct.Struct("<BdBBB")  # kind, cycle, three bytes
_GO = struct.Struct("<BdBH")  # kind, cycle, clear to send, number of bytes
_VOLTS = struct.Struct("<Bd")  # kind, volts over the reference voltage
_CHUNK = 65536


class Surroundings(Protocol):
    """The circuit around the chip. Each call comes with the CPU cycle at which it happens."""

    def port_written(self, cycle: float, port: str, output: int, direction: int) -> None:
        """A port register changed: the pins whose ``direction`` bit is 1 drive their ``output`` bit."""
        ...

    def conversion_started(self, cycle: float, channel: int) -> None:
        """The ADC's sampling capacitor is connected to an input."""
        ...

    def conversion_sampled(self, cycle: float, channel: int) -> float | None:
        """The capacitor is disconnected: its volts over the reference voltage. None: the conversion never ends."""
        ...

    def chip_reset(self, cycle: float) -> None:
        """The watchdog has reset the chip: all pins are inputs."""
        ...


class Processor:
    """An emulated ATmega328P with a program in its flash memory."""

    def __init__(self, engine: Engine, hex_file: Path, eeprom: bytes, surroundings: Surroundings) -> None:
        """Start the chip at cycle 0.

        Raises:
            MissingExtra: the engine cannot run here.
            LinkError: its process could not be started.

        """
        engine.require()
        self.cycle = 0.0
        """CPU cycles since the start"""
        self._name = engine.name
        self._surroundings = surroundings
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
        self._pending = b""
        self._in_use = threading.RLock()  # while the program runs or is ended
        try:
            self._process = subprocess.Popen(
                [*engine.command, str(hex_file), eeprom.hex()],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._complaints,
                bufsize=0,
            )
        except OSError as error:
            self._complaints.close()
            raise LinkError(f"{engine.name}: cannot be started: {error.strerror}") from error

    def run(self, until: float, received: bytes = b"", *, clear_to_send: bool = True) -> bytes:
        """Run to the end of the instruction in which cycle ``until`` falls; the bytes that were transmitted.

        Args:
            until: CPU cycle.
            received: bytes that begin to arrive at the receiver now, back to back.
            clear_to_send: level of the handshake line: whether the other end takes more bytes.

        Raises:
            LinkError: the process has ended, hangs or was closed meanwhile, or the program uses a peripheral that is
                not modelled.

        """
        with self._in_use:
            return self._run(until, received, clear_to_send)

    def _run(self, until: float, received: bytes, clear_to_send: bool) -> bytes:
        assert self._process.stdin is not None
        if self._process.stdin.closed:
            raise LinkError(f"{self._name}: the emulated processor was closed")
        self._tell(_GO.pack(ord("G"), until, clear_to_send, len(received)) + received)
        sent = bytearray()
        handlers: dict[int, Callable[[float, int, int, int], None]] = {
            ord("P"): self._port_written,
            ord("S"): lambda cycle, channel, _b, _c: self._surroundings.conversion_started(cycle, channel),
            ord("A"): self._conversion_sampled,
            ord("U"): lambda _cycle, byte, _b, _c: sent.append(byte),
            ord("W"): lambda cycle, _a, _b, _c: self._surroundings.chip_reset(cycle),
            ord("X"): self._refuse,
        }
        while True:
            for kind, cycle, a, b, c in _RECORD.iter_unpack(self._records()):
                if kind == ord("T"):
                    self.cycle = cycle
                    return bytes(sent)
                if kind not in handlers:
                    raise LinkError(f"{self._name}: sent a record of unknown kind {kind}")
                handlers[kind](cycle, a, b, c)

    def close(self) -> None:
        """End the process, also while another thread lets it run."""
        if not self._in_use.acquire(blocking=False):
            self._process.kill()  # the other thread's wait ends with the process
            self._in_use.acquire()
        try:
            self._end()
        finally:
            self._in_use.release()

    def _end(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(timeout=5)  # the end of its input ends the process
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._complaints.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _port_written(self, cycle: float, port: int, output: int, direction: int) -> None:
        self._surroundings.port_written(cycle, chr(port), output, direction)

    def _conversion_sampled(self, cycle: float, channel: int, _b: int, _c: int) -> None:
        ratio = self._surroundings.conversion_sampled(cycle, channel)
        self._tell(b"H" if ratio is None else _VOLTS.pack(ord("V"), ratio))

    def _refuse(self, cycle: float, low: int, high: int, value: int) -> None:
        raise LinkError(
            f"{self._name}: after {cycle / CLOCK_HZ:.6f} s the program wrote 0x{value:02x} to the register at "
            f"0x{low + 256 * high:02x}, which switches on something that is not modelled"
        )

    def _tell(self, data: bytes) -> None:
        assert self._process.stdin is not None
        try:
            view = memoryview(data)
            while view:
                view = view[self._process.stdin.write(view) :]
        except (BrokenPipeError, ValueError):
            raise self._ended() from None

    def _records(self) -> bytes:
        """Some whole records, waiting for the first."""
        assert self._process.stdout is not None
        output = self._process.stdout.fileno()
        while len(self._pending) < _RECORD.size:
            ready, _, _ = select.select([output], [], [], DRAIN_S)
            if not ready:
                raise LinkError(f"{self._name}: the emulated processor has hung for {DRAIN_S:g} s")
            data = os.read(output, _CHUNK)
            if not data:
                raise self._ended()
            self._pending += data
        whole = len(self._pending) - len(self._pending) % _RECORD.size
        records, self._pending = self._pending[:whole], self._pending[whole:]
        return records

    def _ended(self) -> LinkError:
        self._process.wait()
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").strip().splitlines()
        reason = lines[-1] if lines else f"exit code {self._process.returncode}"
        return LinkError(f"{self._name}: the emulated processor has ended: {reason}")
