"""Protocol identification: what is behind an unknown serial port, and at which baud rate?

What arrives goes through the decoders of all families, and the family whose decoder accounts for most of the bytes is
named. Where none does, a BOARD.toml is drafted from the bytes (:mod:`._draft`). Other baud rates than the first are
tried only where the port has a UART; a port that is silent is asked in the way of each family that waits to be asked.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from ..common.text import shortened
from ..driver import BytePort, open_port
from ..wire import BOARDS, CHECKSUMS, Corrupt, Description, Family, FramePacket, Identity, Order, host_protocol
from ._draft import Draft, decoded, draft
from ._finding import Finding, State
from ._guess import Chunk
from ._text_guess import is_text
from ._tuning import (
    ANSWERED_S,
    ASKED,
    ASKED_AGAIN,
    FEWEST_FRAMES,
    LEAST_ACCOUNTED,
    LISTEN_S,
    LONGEST_LISTENING_S,
    MOST_IDLE,
    PROGRESS_S,
    QUIET_S,
    STILL_ALIVE,
    SURE,
)

COMMON_RATES = (115_200, 1_000_000, 250_000, 2_000_000, 500_000, 921_600, 9_600, 230_400, 57_600, 460_800, 38_400)
"""baud rates of boards, those of the families among them, in the order in which they are tried"""
START_WORDS = (
    *(b"a", b"A", b"s", b"S", b"r", b"R", b"t", b"T", b"g", b"1", b"?", b" ", b"\r\n", b"start\n", b"START\r\n"),
    *(b"read\n", b"READ\r\n", b"get\n", b"GET\r\n", b"trigger\n", b"TRIGGER\r\n", b"stream\n", b"begin\n", b"go\n"),
    b"start_reading\n",
)
"""what public sketches wait for before they send, or before each frame"""
MODBUS_FUNCTIONS = 4, 3
"""read input registers, read holding registers (Modbus application protocol V1.1b3, 6.3 and 6.4)"""
MODBUS_REGISTERS = ((7, 32), (7, 36), (0, 16), (0, 32), (0, 64))
"""first and number of the registers that sensors of device 1 keep their cells in"""
SHOWN_BYTES = 16
SHOWN_TEXT = 60


@dataclass(frozen=True)
class Verdict:
    """How well one family's decoder accounts for the bytes that came."""

    family: Family
    frames: int
    shape: tuple[int, int] | None
    """(rows, columns) of the last frame"""
    corrupt_bytes: int
    identified: bool
    """the board said who it is"""

    def accounted(self, received: int) -> float:
        """Share of ``received`` bytes that belong to packets."""
        return 1.0 - min(self.corrupt_bytes / received, 1.0)

    def convincing(self, received: int) -> bool:
        """Whether the bytes can hardly be anything else."""
        enough = self.frames >= FEWEST_FRAMES or self.identified
        return enough and self.accounted(received) > LEAST_ACCOUNTED


@dataclass(frozen=True)
class Traffic:
    """What was heard at a port."""

    finding: Finding
    draft: Draft | None
    """description of a board of no known family"""
    baud_rate: int
    """at which it was heard"""
    family: str = ""
    """name of the family that the board sounds like"""


@dataclass(frozen=True)
class _Setting:
    """A way to open the port."""

    baud_rate: int
    dtr: bool | None
    rts: bool | None


Tell = Callable[[str], None]
"""called with what is being done, several times in a second"""


def examine_traffic(
    port: str,
    *,
    listen_s: float | None = None,
    baud: int | None = None,
    described: bool = False,
    poke: Callable[[], bool] | None = None,
    tell: Tell = lambda text: None,
) -> Traffic:
    """Listen to a port, and ask where it is silent; name the family, or draft a description.

    Args:
        port: a serial device, a pty, or ``socket://HOST:PORT``.
        listen_s: how long to listen before the bytes are judged, in s; None: :data:`LISTEN_S`.
        baud: the only baud rate to try; None: all common ones, if the port has a UART.
        described: draft a description, whatever family the board sounds like.
        poke: asked, where the port stays silent, whether :data:`START_WORDS` may be sent; None: they may not.
        tell: progress.

    Raises:
        LinkError: the port cannot be opened or went away.

    """
    listen_s = LISTEN_S if listen_s is None else listen_s
    heard: dict[int, list[Chunk]] = {}
    spare: Traffic | None = None
    for setting in _settings(port, baud):
        silent = bool(heard) and not any(heard.values())
        line = open_port(port, baudrate=setting.baud_rate, dtr=setting.dtr, rts=setting.rts)
        try:
            one = _Listener(port, line, setting.baud_rate, listen_s, described, tell)
            found = one.listened(LISTEN_S / ASKED if silent else listen_s)
            if found is None and one.waits():
                for family in _families_to_ask(port, setting):
                    found = found or one.answer(family.name, _orders(family))
                for name, word in () if found is not None or poke is None or not poke() else _words():
                    found = found or one.answer(name, [word])
        finally:
            line.close()
        if found is not None and (found.draft is None or _shows_where_frames_begin(found.draft)):
            return found
        spare = spare or found  # a wrong baud rate leaves the pauses between frames as they are
        heard[setting.baud_rate] = one.chunks
    return spare or Traffic(_not_recognised(port, heard), None, max(heard, key=lambda rate: len(_joined(heard[rate]))))


@dataclass
class _Listener:
    """An open port, and what has come there at one baud rate."""

    port: str
    line: BytePort
    baud_rate: int
    listen_s: float
    described: bool
    tell: Tell
    chunks: list[Chunk] = field(default_factory=list)
    idle: tuple[bytes, ...] = ()
    """lines that the board says over and over while it waits for something"""

    def listened(self, listen_s: float) -> Traffic | None:
        """What comes by itself; longer if bytes come that are no frames yet."""
        passed_s, found = 0.0, None
        while passed_s < LONGEST_LISTENING_S * listen_s / LISTEN_S:
            self._collect(self.chunks, listen_s)
            passed_s += listen_s
            if not self.chunks:
                return None
            found = self._judged(self.chunks)
            if found is not None and (found.draft is None or found.draft.is_clear):
                return found
        return found

    def waits(self) -> bool:
        """Whether nothing has come lately but what a board says over and over, which is known from now on."""
        lines = _joined(self.chunks).split(b"\n")[1:-1] if is_text(self.chunks) else []
        kinds = set(lines)
        self.idle = tuple(kinds) if 2 * len(kinds) <= len(lines) and len(kinds) <= MOST_IDLE else ()
        return bool(self.idle) or not self.chunks or self.line.now() - self.chunks[-1].time_s > QUIET_S

    def answer(self, name: str, requests: Sequence[bytes]) -> Traffic | None:
        """What comes after a way of asking; a board that answers and is silent again is asked again.

        One that goes on by itself was started; if it stops after a while, it wants to hear the start again and again.
        """
        answer: list[Chunk] = []
        doing = f"silent; asking by {name}"
        for request in requests:
            self.line.write(request)
            self._collect(answer, self.listen_s / ASKED, doing)
        if not self._without_idle(answer):
            return None
        began_at, first = self.line.now(), len(answer)
        for _ in range(ASKED_AGAIN):
            self.line.write(requests[-1])
            asked_at = self.line.now()
            self._collect(answer, self.listen_s / ASKED, doing, pause_s=ANSWERED_S)
        rate = len(_joined(self._without_idle(answer[first:]))) / (self.line.now() - began_at)
        answer = self._without_idle(answer)
        self.chunks += answer
        after: list[Chunk] = []
        self._collect(after, self.listen_s)
        if len(_joined(self._without_idle(after))) <= rate * self.listen_s / 2:
            return self._judged(answer, poll=requests[-1])
        self._collect(after, self.listen_s)
        started = self._without_idle(after)
        stopped = self.line.now() - started[-1].time_s > QUIET_S * min(self.listen_s / LISTEN_S, 1.0)
        every_s = round(STILL_ALIVE * (started[-1].time_s - asked_at), 1) if stopped else 0.0
        return self._judged(started, send=requests[-1], every_s=every_s)

    def _without_idle(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """What came besides the lines of a board that waits."""
        left = []
        for chunk in chunks:
            data = chunk.data
            for one in self.idle:
                data = data.replace(one + b"\n", b"")
            left += [Chunk(chunk.time_s, data)] if data else []
        return left

    def _collect(
        self, chunks: list[Chunk], seconds: float, doing: str = "listening", *, pause_s: float = math.inf
    ) -> None:
        """Append what comes within some seconds, or until nothing more comes for ``pause_s``."""
        line = self.line
        end, came = line.now() + seconds, math.inf
        while (left := min(end, came + pause_s) - line.now()) > 0:
            self.tell(f"{self.port}: {doing} at {self.baud_rate} baud, {len(_joined(chunks))} bytes")
            if line.wait(min(left, PROGRESS_S)):
                arrival = line.read()
                if arrival.data:
                    chunks.append(Chunk(arrival.received_at, arrival.data))
                    came = line.now()

    def _judged(self, chunks: Sequence[Chunk], **sent: Any) -> Traffic | None:
        """The family that the bytes are of, or the description that accounts for them (:func:`.draft`)."""
        data = _joined(chunks)
        verdict = None if self.described else judge(data)
        known = None
        if verdict is not None:
            finding = _recognised(self.port, self.baud_rate, data, verdict)
            known = Traffic(finding, None, self.baud_rate, verdict.family.name)
            if verdict.family.tables is None or decoded(verdict.family, chunks)[1] > SURE:
                return known
        # The formats of files have little that tells them from others: one that accounts for more bytes is right.
        found = draft(chunks, baudrate=self.baud_rate, **sent)
        if found is None or (known is not None and found.accounted < SURE):
            return known
        return Traffic(_described(self.port, self.baud_rate, chunks, found), found, self.baud_rate)


def judge(data: bytes) -> Verdict | None:
    """The family whose packets account for most of ``data``; None where none does convincingly."""
    verdicts = [verdict for family in BOARDS.values() if (verdict := _decoded(family, data)).convincing(len(data))]
    return max(verdicts, key=lambda verdict: verdict.accounted(len(data)), default=None)


def _decoded(family: Family, data: bytes) -> Verdict:
    frames, shape, corrupt, identified = 0, None, 0, False
    for event in host_protocol(family.name).feed(data, 0.0):
        match event:
            case FramePacket():
                frames, shape = frames + 1, (event.rows, event.columns)
            case Corrupt():
                corrupt += event.size
            case Identity() | Description():
                identified = True
    return Verdict(family, frames, shape, corrupt, identified)


def has_baud_rate(port: str) -> bool:
    """Whether a port has a UART, whose baud rate matters: not a pseudo-terminal, and not a bare socket."""
    return port.startswith("rfc2217:") if "://" in port else not os.path.realpath(port).startswith("/dev/pts/")


def _settings(port: str, baud: int | None) -> list[_Setting]:
    if baud is not None:
        return [_Setting(baud, None, None)]
    if not has_baud_rate(port):
        return [_Setting(COMMON_RATES[0], None, None)]
    lines = {(family.baud_rate, family.dtr, family.rts): None for family in BOARDS.values()}
    rates = dict.fromkeys(_Setting(rate, None, None) for rate in COMMON_RATES)
    return [*rates, *(setting for line in lines if (setting := _Setting(*line)) not in rates)]


def _families_to_ask(port: str, setting: _Setting) -> list[Family]:
    """Families that send nothing, or not everything, without being asked."""
    asking = [family for family in BOARDS.values() if family.polled or family.has_description]
    return [family for family in asking if not has_baud_rate(port) or family.baud_rate == setting.baud_rate]


def _words() -> Iterator[tuple[str, bytes]]:
    """What may make a silent board send, with names."""
    yield from ((repr(word.decode()), word) for word in START_WORDS)
    for function, (first, count) in product(MODBUS_FUNCTIONS, MODBUS_REGISTERS):
        request = struct.pack(">BBHH", 1, function, first, count)
        yield f"Modbus registers {first} to {first + count - 1}", request + CHECKSUMS["crc16-modbus"].of(request)


def _orders(family: Family) -> list[bytes]:
    """What makes a board of a family send."""
    protocol = host_protocol(family.name)
    orders = [Order.ONE_FRAME] if family.polled else [Order.IDENTIFY, Order.START]
    return [protocol.request(order) for order in orders]


def _shows_where_frames_begin(found: Draft) -> bool:
    frame = found.guess.tables["frame"]
    return frame["format"] != "binary" or "header" in frame or "framing" in frame


def _joined(chunks: Sequence[Chunk]) -> bytes:
    return b"".join(chunk.data for chunk in chunks)


def _recognised(port: str, baud_rate: int, data: bytes, verdict: Verdict) -> Finding:
    shape = "" if verdict.shape is None else ", {} x {} cells".format(*verdict.shape)
    share = 100 * verdict.accounted(len(data))
    found = (
        f"sounds like a board of the family '{verdict.family.name}' at {baud_rate} baud{shape}: "
        f"{verdict.frames} frames, {share:.0f} % of {len(data)} bytes in packets"
    )
    other = "if it is another board, describe it: " + f"ohmskin doctor {port} --draft"
    return Finding(State.OK, port, found, other if verdict.family.tables is not None else "")


def _described(port: str, baud_rate: int, chunks: Sequence[Chunk], found: Draft) -> Finding:
    rate = f" at {baud_rate} baud" if has_baud_rate(port) else ""
    share = 100 * found.accounted
    text = (
        f"sends {found.summary}{rate}: {found.frames} frames, {share:.0f} % of {len(_joined(chunks))} bytes in frames"
    )
    return Finding(State.OK, port, f"{text}, {_sample(chunks)}")


def _sample(chunks: Sequence[Chunk]) -> str:
    """The beginning of a late line of text, or the first bytes."""
    data = _joined(chunks)
    if not is_text(chunks):
        return f"beginning with {data[:SHOWN_BYTES].hex(' ')}"
    lines = [line for line in data.decode("ascii", "replace").splitlines()[1:-1] if line.strip()] or [""]
    return f"such as {shortened(lines[-1].strip(), SHOWN_TEXT)!r}"


def _not_recognised(port: str, heard: dict[int, list[Chunk]]) -> Finding:
    rates = ", ".join(map(str, heard))
    baud_rate, chunks = max(heard.items(), key=lambda item: len(_joined(item[1])))
    data = _joined(chunks)
    at = f" at {rates} baud" if has_baud_rate(port) else ""
    if not data:
        mend = "press the board's reset button, try another cable (some only charge), and run this again"
        return Finding(State.PROBLEM, port, f"silent{at}, also when asked in each family's way", mend)
    found = (
        f"sends what no known family does, and nothing that looks like frames: {len(data)} bytes at {baud_rate} baud, "
        f"{_text_share(data):.0f} % of them text, {_sample(chunks)}"
    )
    mend = (
        "if the board waits for a command, send it with [start] of a BOARD.toml (docs/boards.md); if it has another "
        f"baud rate than {rates}, give --baud; known families: {', '.join(BOARDS)}"
    )
    return Finding(State.PROBLEM, port, found, mend)


def _text_share(data: bytes) -> float:
    """Percentage of printable ASCII characters and line ends."""
    return 100 * sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in data) / len(data)
