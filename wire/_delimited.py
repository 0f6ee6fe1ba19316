"""Packets between bytes that stand nowhere else: how the bytes between two such delimiters become those of a frame.

=============  ========================================================================================================
``cobs``       zeros end packets (Cheshire and Baker, "Consistent Overhead Byte Stuffing", 1999)
``slip``       0xC0 begins and ends them; 0xDB 0xDC and 0xDB 0xDD stand for 0xC0 and 0xDB (RFC 1055)
``zero-runs``  0xFF ends them; a zero and a count stand for so many zeros (sketches of FSR matrices)
=============  ========================================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import groupby

from cobs import cobs

_END, _ESCAPE, _ESCAPED_END, _ESCAPED_ESCAPE = b"\xc0", b"\xdb", b"\xdb\xdc", b"\xdb\xdd"
_LONGEST_RUN = 254


@dataclass(frozen=True)
class Framing:
    """One way of framing."""

    delimiter: int
    decode: Callable[[bytes, int], bytes]
    """bytes between two delimiters, and the usual length -> those of the frame; ValueError: they are none"""
    write: Callable[[bytes], bytes]
    """bytes of a frame -> those on the line, with delimiters"""


def _from_cobs(stretch: bytes, size: int) -> bytes:
    try:
        return bytes(cobs.decode(stretch))
    except cobs.DecodeError as error:
        raise ValueError(f"not COBS: {error}") from error


def _from_slip(stretch: bytes, size: int) -> bytes:
    plain = stretch.replace(_ESCAPED_END, _END)
    if stretch.count(_ESCAPE) != stretch.count(_ESCAPED_END) + stretch.count(_ESCAPED_ESCAPE):
        raise ValueError("not SLIP: a byte 0xDB that escapes nothing")
    return plain.replace(_ESCAPED_ESCAPE, _ESCAPE)


def _from_runs(stretch: bytes, size: int) -> bytes:
    found, at = bytearray(), 0
    while at < len(stretch) and len(found) <= size:
        if stretch[at]:
            found.append(stretch[at])
            at += 1
            continue
        if at + 1 == len(stretch) or not stretch[at + 1]:
            raise ValueError("no run of zeros: a zero without a count")
        found += bytes(stretch[at + 1])
        at += 2
    return bytes(found)


def _as_runs(frame: bytes) -> bytes:
    sent = bytearray()
    for is_zero, run in groupby(frame, key=lambda byte: byte == 0):
        length = len(list(run)) if is_zero else 0
        for left in range(length, 0, -_LONGEST_RUN):
            sent += bytes([0, min(left, _LONGEST_RUN)])
        if not is_zero:
            sent += bytes(min(byte, _LONGEST_RUN) for byte in run)
    return bytes(sent) + b"\xff"


FRAMINGS: Mapping[str, Framing] = {
    "cobs": Framing(0, _from_cobs, lambda frame: bytes(cobs.encode(frame)) + b"\0"),
    "slip": Framing(
        0xC0,
        _from_slip,
        lambda frame: _END + frame.replace(_ESCAPE, _ESCAPED_ESCAPE).replace(_END, _ESCAPED_END) + _END,
    ),
    "zero-runs": Framing(0xFF, _from_runs, _as_runs),
}
"""by name"""
