"""Protocol identification: which family of boards does an unknown serial port sound like, and at which baud rate?

The port is opened at the baud rate of every known family in turn. What arrives goes through the decoders of all
families, since USB serial ports work at any rate. The family whose decoder accounts for most of the bytes is named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from ..driver import BytePort, open_port
from ..wire import BOARDS, Corrupt, Description, Family, FramePacket, Identity, Order, host_protocol
from ._finding import Finding, State

LISTEN_S = 1.5
"""how long to listen at each baud rate: the slowest family sends two frames in a second"""
FEWEST_FRAMES = 2
MOST_CORRUPT = 0.5
"""share of the bytes that may be no part of a packet; a recording begins and ends within a packet"""
SHOWN_BYTES = 16


@dataclass(frozen=True)
class Verdict:
    """How well one family's decoder accounts for the bytes that came."""

    family: Family
    frames: int
    shape: tuple[int, int] | None
    """(rows, columns) of the last frame"""
    corrupt_bytes: int
    introduced: bool
    """the board said who it is"""

    def accounted(self, received: int) -> float:
        """Share of ``received`` bytes that belong to packets."""
        return 1.0 - min(self.corrupt_bytes / received, 1.0)

    def convincing(self, received: int) -> bool:
        """Whether the bytes can hardly be anything else."""
        enough = self.frames >= FEWEST_FRAMES or self.introduced
        return enough and self.accounted(received) > 1.0 - MOST_CORRUPT


@dataclass(frozen=True)
class _Setting:
    """A way to open the port."""

    baud_rate: int
    dtr: bool | None
    rts: bool | None


def examine_traffic(port: str, *, listen_s: float | None = None) -> list[Finding]:
    """Listen to a port, and ask where it is silent; the finding names the family and the baud rate.

    Args:
        port: a serial device, a pty, or ``socket://HOST:PORT``.
        listen_s: how long to listen at each baud rate, in s; None: :data:`LISTEN_S`.

    Raises:
        LinkError: the port cannot be opened or went away.

    """
    listen_s = LISTEN_S if listen_s is None else listen_s
    heard: dict[int, bytes] = {}
    for setting, families in _settings().items():
        for data in _recordings(port, setting, families, listen_s):
            verdict = judge(data)
            if verdict is not None:
                return [_recognised(port, setting.baud_rate, data, verdict)]
            heard[setting.baud_rate] = max(heard.get(setting.baud_rate, b""), data, key=len)
    return [_not_recognised(port, heard, listen_s)]


def judge(data: bytes) -> Verdict | None:
    """The family whose packets account for most of ``data``; None where none does convincingly."""
    verdicts = [verdict for family in BOARDS.values() if (verdict := _decoded(family, data)).convincing(len(data))]
    return max(verdicts, key=lambda verdict: verdict.accounted(len(data)), default=None)


def _decoded(family: Family, data: bytes) -> Verdict:
    frames, shape, corrupt, introduced = 0, None, 0, False
    for event in host_protocol(family.name).feed(data, 0.0):
        match event:
            case FramePacket():
                frames, shape = frames + 1, (event.rows, event.columns)
            case Corrupt():
                corrupt += event.size
            case Identity() | Description():
                introduced = True
    return Verdict(family, frames, shape, corrupt, introduced)


def _settings() -> dict[_Setting, list[Family]]:
    """Families that are opened alike, the native one first."""
    settings: dict[_Setting, list[Family]] = {}
    for family in BOARDS.values():
        settings.setdefault(_Setting(family.baud_rate, family.dtr, family.rts), []).append(family)
    return settings


def _recordings(port: str, setting: _Setting, families: list[Family], listen_s: float) -> Iterator[bytes]:
    """What comes by itself, then what comes after each family's own way of asking."""
    line = open_port(port, baudrate=setting.baud_rate, dtr=setting.dtr, rts=setting.rts)
    try:
        yield _collected(line, listen_s)
        for family in families:
            protocol = host_protocol(family.name)
            orders = [Order.ONE_FRAME] * FEWEST_FRAMES if family.polled else [Order.IDENTIFY, Order.START]
            data = b""
            for order in orders:
                line.write(protocol.request(order))
                data += _collected(line, listen_s / len(orders))
            yield data
    finally:
        line.close()


def _collected(line: BytePort, seconds: float) -> bytes:
    data = bytearray()
    end = line.now() + seconds
    while (left := end - line.now()) > 0:
        if line.wait(left):
            data += line.read().data
    return bytes(data)


def _recognised(port: str, baud_rate: int, data: bytes, verdict: Verdict) -> Finding:
    shape = "" if verdict.shape is None else ", {} x {} cells".format(*verdict.shape)
    share = 100 * verdict.accounted(len(data))
    found = (
        f"sounds like a board of the family '{verdict.family.name}' at {baud_rate} baud{shape}: "
        f"{verdict.frames} frames, {share:.0f} % of {len(data)} bytes in packets"
    )
    return Finding(State.OK, port, found)


def _not_recognised(port: str, heard: dict[int, bytes], listen_s: float) -> Finding:
    rates = ", ".join(map(str, sorted(heard)))
    baud_rate, data = max(heard.items(), key=lambda item: len(item[1]))
    if not data:
        mend = "press the board's reset button, try another cable (some only charge), and run this again"
        return Finding(State.PROBLEM, port, f"silent at {rates} baud, {listen_s:g} s each, also when asked", mend)
    found = (
        f"sends what no known family does: {len(data)} bytes at {baud_rate} baud, beginning with "
        f"{data[:SHOWN_BYTES].hex(' ')}, {_text_share(data):.0f} % of them text"
    )
    mend = f"check that the board's baud rate is one of {rates}; known families: {', '.join(BOARDS)}"
    return Finding(State.PROBLEM, port, found, mend)


def _text_share(data: bytes) -> float:
    """Percentage of printable ASCII characters and line ends."""
    return 100 * sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in data) / len(data)
