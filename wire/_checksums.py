"""Checksums of binary frames, as the bytes that stand on the line."""

from __future__ import annotations

import binascii
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, reduce
from operator import xor


@dataclass(frozen=True)
class Checksum:
    """One kind of checksum."""

    size: int
    """bytes"""
    of: Callable[[bytes], bytes]
    """the checksum of some bytes, as it is sent"""


def _crc8(data: bytes) -> int:
    """CRC-8 with the polynomial 0x07, start 0 (SMBus specification 3.1, 6.4.1.1)."""
    table = _table(0x07, reflected=False)
    return reduce(lambda crc, byte: table[crc ^ byte], data, 0)


def _crc16_modbus(data: bytes) -> int:
    """CRC-16 with the polynomial 0x8005 reflected, start 0xFFFF (Modbus over serial line, V1.02, 2.5.1.2)."""
    table = _table(0xA001, reflected=True)
    return reduce(lambda crc, byte: crc >> 8 ^ table[(crc ^ byte) & 0xFF], data, 0xFFFF)


@cache
def _table(polynomial: int, *, reflected: bool) -> tuple[int, ...]:
    """What each byte makes of a CRC; not reflected: of one of 8 bits."""

    def entry(crc: int) -> int:
        for _ in range(8):
            if reflected:
                crc = crc >> 1 ^ (polynomial if crc & 1 else 0)
            else:
                crc = (crc << 1 ^ (polynomial if crc & 0x80 else 0)) & 0xFF
        return crc

    return tuple(map(entry, range(256)))


def _kinds() -> dict[str, Checksum]:
    numbers: dict[str, tuple[int, Callable[[bytes], int]]] = {
        "sum16": (2, lambda data: sum(data) % 2**16),
        "crc16-ccitt": (2, lambda data: binascii.crc_hqx(data, 0xFFFF)),
        "crc16-xmodem": (2, lambda data: binascii.crc_hqx(data, 0)),
        "crc16-modbus": (2, _crc16_modbus),
        "crc32": (4, zlib.crc32),
    }
    kinds = {
        "sum8": Checksum(1, lambda data: bytes([sum(data) % 256])),
        "crc8": Checksum(1, lambda data: bytes([_crc8(data)])),
        "xor8": Checksum(1, lambda data: bytes([reduce(xor, data, 0)])),
    }
    for name, (size, of) in numbers.items():
        little, big = ("le", "be") if name == "sum16" else ("", "-be")
        kinds[name + little] = Checksum(size, lambda data, n=size, f=of: f(data).to_bytes(n, "little"))  # type: ignore[misc]
        kinds[name + big] = Checksum(size, lambda data, n=size, f=of: f(data).to_bytes(n, "big"))  # type: ignore[misc]
    return kinds


CHECKSUMS: Mapping[str, Checksum] = _kinds()
"""by name; those that do not say so are little-endian"""
