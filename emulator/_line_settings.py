"""The tables ``[line]``, ``[clock]`` and ``[[link_fault]]`` of SCENE.toml: how bytes travel from board to host."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ..common.config import Finite, NotNegative, Positive, Section

Share = Annotated[float, Field(ge=0, lt=1)]

BYTE_FAULTS = ("flipped-bits", "dropped-bytes", "inserted-bytes", "duplicated-bytes")
PACKET_FAULTS = ("dropped-packets", "duplicated-packets")
FaultKind = Literal[
    "flipped-bits",
    "dropped-bytes",
    "inserted-bytes",
    "duplicated-bytes",
    "dropped-packets",
    "duplicated-packets",
    "split-bytes",
    "stall",
    "reset",
    "unplug",
    "second-host",
]
BOOT_TEXT = "\r\nBoard starting\r\nreset cause: external\r\n"


class LineSettings(Section):
    """``[line]``: a UART or USB link, what it can carry, and how much noise it adds."""

    packet_loss: Share = 0.0
    """chance that a packet vanishes"""
    bit_errors: Share = 0.0
    """chance of each bit to be flipped"""
    baud_rate: Annotated[int, Field(ge=300, le=100_000_000)] | None = None
    """bit/s of a UART, ten for each byte; None: the board has USB of its own, which is as fast as the host"""
    board_buffer: Annotated[int, Field(ge=64)] | None = None
    """bytes that the board can hold ready to send; None: 8192 and four frames"""
    host_buffer: Annotated[int, Field(ge=64)] = 65536
    """bytes that the host's USB bridge and driver hold; behind a UART, bytes beyond are lost"""
    usb_packet: Annotated[int, Field(ge=1)] | None = None
    """bytes of payload in a packet of the USB bridge (FTDI at full speed: 62); None: bytes pass one by one"""
    latency_s: Annotated[float, Field(ge=0, le=60)] = 0.0
    """that a partly filled USB packet waits (FTDI's latency timer: 0.016)"""
    auto_reset: bool = False
    """True: a host that opens the port or raises DTR resets the board, as on an Arduino"""


class ClockSettings(Section):
    """``[clock]``: the board's own clock beside the host's."""

    offset_s: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    """that the board's clock shows when the emulation begins"""
    drift_ppm: Annotated[Finite, Field(ge=-100_000, le=100_000)] = 0.0
    """by how much the board's clock is fast, in parts per million"""
    jitter_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    """standard deviation of the delay (half a normal distribution) with which the board sends a frame"""


class LinkFault(Section):
    """``[[link_fault]]``: something that goes wrong on the link, at a time or with a probability."""

    kind: FaultKind
    at_s: NotNegative = 0.0
    """board time at which the fault begins"""
    duration_s: Positive | None = None
    """how long the fault lasts; None: 1 s, or without end for a fault that has a probability"""
    every_s: Positive | None = None
    """time after which the fault comes again; None: never"""
    probability: Annotated[float, Field(gt=0, le=1)] | None = None
    """of each byte (each packet) to be hit while the fault lasts; None: ``count`` are hit in the first packet"""
    count: Annotated[int, Field(ge=1)] = 1
    """bytes (packets) that are hit where no probability is given"""
    text: Annotated[str, Field(max_length=4096)] = BOOT_TEXT
    """reset only: what the boot loader prints on the line"""
    name: Annotated[str, Field(min_length=1, max_length=255, pattern=r"^[^/\x00]+$")] | None = None
    """unplug only: where the board appears again; None: where it was"""

    @model_validator(mode="after")
    def _keys_fit_the_kind(self) -> Self:
        random = self.kind in BYTE_FAULTS + PACKET_FAULTS
        if self.probability is not None and not random:
            raise ValueError(f"a fault of kind '{self.kind}' has no probability; it happens at a time")
        if self.name is not None and self.kind != "unplug":
            raise ValueError(f"a fault of kind '{self.kind}' has no name; only 'unplug' has one")
        if self.every_s is not None and self.duration_s is not None and self.duration_s > self.every_s:
            raise ValueError(
                f"the fault lasts {self.duration_s} s and comes every {self.every_s} s; expected a shorter duration"
            )
        return self

    @property
    def length_s(self) -> float:
        """How long each occurrence lasts."""
        if self.duration_s is not None:
            return self.duration_s
        return float("inf") if self.probability is not None else 1.0

    def occurrence(self, time_s: float) -> int:
        """Number of the occurrence that began last at ``time_s``, from 0; -1 before the first."""
        if time_s < self.at_s:
            return -1
        return 0 if self.every_s is None else int((time_s - self.at_s) // self.every_s)

    def active(self, time_s: float) -> bool:
        """Whether the fault is going on at ``time_s``."""
        occurrence = self.occurrence(time_s)
        if occurrence < 0:
            return False
        began = self.at_s + (0.0 if self.every_s is None else occurrence * self.every_s)
        return time_s < began + self.length_s
