"""Small recordings that ask for much: files of an untrusted sender."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterable
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from boards import frame, identity, scene, sheet
from mcap.writer import IndexType, Writer

from ohmskin.wire import write_description

DEEP = 256 * 2**20
"""bytes of a chunk of :func:`deep_chunks`"""


def deep_chunks(path: Path, count: int = 50, *, said: int = DEEP, compression: str = "zstd") -> None:
    """Chunks of 256 MiB, which zstd makes 8 kB of: zeros are records of an unknown kind, of 9 bytes each."""
    content = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression](bytes(DEEP))
    name = compression.encode()
    head = struct.pack("<QQQII", 0, 0, said, 0, len(name)) + name + struct.pack("<Q", len(content))
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        begin(writer)
        for _ in range(count):
            file.write(struct.pack("<BQ", 6, len(head) + len(content)) + head + content)
        writer.finish()


def many_tares(path: Path, count: int = 300_000, frames: tuple[int, ...] = ()) -> None:
    """A board that is tared between two frames, over and over."""
    rest = base64.b64encode(np.full(6, 1e4).tobytes()).decode()
    event = {"event": "rest", "rest_ohm": rest, "after_frame": 1}
    seen = [("/ohmskin/bytes", struct.pack("<dd", number, number) + frame(number)) for number in frames]
    write(path, [*seen, *[("/ohmskin/events", json.dumps(event).encode())] * count])


def many_arrivals(path: Path, count: int = 1_500_000) -> None:
    """Arrivals of one byte each, at the same time."""
    write(path, [("/ohmskin/bytes", struct.pack("<dd", 1.0, 1.0) + b"\0")] * count)


def write(path: Path, messages: Iterable[tuple[str, bytes]]) -> None:
    """A recording of a board that has said who it is, with further messages; without the index of messages."""
    with path.open("wb") as file:
        writer = Writer(file, index_types=IndexType.NONE)
        channels = begin(writer)
        said = struct.pack("<dd", 0.0, 0.0) + identity() + sheet()
        for topic, data in [("/ohmskin/bytes", said), *messages]:
            writer.add_message(channels[topic], 0, data, 0)
        writer.finish()


def begin(writer: Writer) -> dict[str, int]:
    """Head and metadata of a recording; the channels of its topics."""
    writer.start()
    skin = scene().skin
    given = write_description(skin.design.model_dump(), skin.cell.model_dump()).decode()
    writer.add_metadata("ohmskin", {"format": "1", "board": "ohmskin", "given": given})
    return {topic: writer.register_channel(topic, "json", 0) for topic in ("/ohmskin/bytes", "/ohmskin/events")}
