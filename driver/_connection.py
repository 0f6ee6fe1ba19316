"""Connection to one board: a thread reads the port, reopens it after a loss, and passes decoded frames on."""

from __future__ import annotations

import contextlib
import copy
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from math import inf

from ..common.events import SignalSafeEvent
from ..common.text import shortened
from ..errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError, ProtocolError
from ..wire import Corrupt, Description, Event, Flag, FramePacket, HostProtocol, Identity, Order
from ._converted import Converted
from ._frames import Frames
from ._handshake import Handshake
from ._orders import Answer, PendingOrder
from ._port import Arrival, BytePort
from ._reconnect import attempts
from ._recording import Recording
from ._stream import FrameStream, RawFrame
from ._tuning import (
    ANSWER_LIES_BEHIND,
    ASK_AGAIN_S,
    CLOSE_S,
    GONE_S,
    LONGEST_REST_S,
    LONGEST_TURN_S,
    MANY,
    POLL_S,
    READ_AGAIN_S,
    RECENT_FRAMES,
    RELEASE_S,
    TEXT_SHARE,
)

_NO_FLAGS = Flag.NONE  # operations on flags take 1 us each


def await_free(name: str) -> None:
    """Wait until a closing skin of this process has released the port ``name``."""
    if "://" in name:  # a server may take several hosts
        return
    place = os.path.realpath(name)
    for connection in list(_CONNECTIONS):
        port = connection._port
        if port is None or not connection._is_ending or os.path.realpath(port.name) != place:
            continue
        if connection._thread.is_alive() and connection._thread is not threading.current_thread():
            connection._thread.join(RELEASE_S)


SAMPLE_BYTES = 200
"""that a message may show of bytes that are no packets"""
SHOWN = 40


def looks_of(data: bytes, sent: bytes = b"") -> str:
    """What bytes look like, for a message: an echo, a web server's answer, a line of text, or numbers."""
    if sent and sent in data:
        return "which are those that were sent: an echo, such as of a loopback plug or a terminal"
    if data.lstrip().startswith(b"HTTP/") or b"<html" in data.lower():
        return "the answer of a web server"
    printable_bytes = sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in data)
    if printable_bytes > TEXT_SHARE * len(data):
        lines = [line.strip() for line in data.decode("ascii", "replace").splitlines() if line.strip()]
        return f"text such as {shortened(lines[-2] if len(lines) > 1 else ''.join(lines[-1:]), SHOWN)!r}"
    return f"binary such as {data[:16].hex(' ')}"


@dataclass
class Absence:
    """The time from the loss of the port until the board there has proved that it is the one from before."""

    since_s: float
    because: LinkError
    proof_until_s: float = inf
    """infinite until the port is there again"""
    unproven: set[type[object]] = field(default_factory=set)
    """types of the packets that are still missing for the proof"""
    waiting: deque[tuple[FramePacket, Arrival]] = field(default_factory=lambda: deque(maxlen=RECENT_FRAMES))
    """frames that arrived before the proof was complete"""


class Connection:
    """Reads one board in a thread of its own, from opening to closing.

    Two parties read the port. The thread waits for bytes. A consumer also reads the bytes that are there before it
    looks for a frame (:meth:`poll`), since Python may keep the thread from running for some milliseconds.
    """

    def __init__(
        self,
        port: BytePort,
        *,
        protocol: Callable[[], HostProtocol],
        handshake: Handshake,
        frames: Frames,
        reopen: Callable[[], BytePort] | None,
        reconnect_s: float,
    ) -> None:
        self.port_name = port.name
        self.handshake = handshake
        self.known = SignalSafeEvent()
        """set when the handshake is complete, or will never be"""
        self.frames = frames
        self.stream = FrameStream(port.name, frames.counters, simulated=getattr(port, "is_simulated", False))
        self._sample = b""
        """the last bytes before the first frame"""
        self._sent = b""
        """the last order: where it comes back, a message says so"""
        self.taps: list[Callable[[Arrival], None]] = []
        """called with all bytes, as they arrive: for a recorder"""
        self.recordings: dict[Recording, Callable[[RawFrame, Converted], None] | None] = {}
        """recordings in progress, and what gives them converted frames"""
        self._port: BytePort | None = port
        self._clock = port.now  # of the last port, which a recording has after its end, too
        self._family = handshake.family
        self._new_protocol = protocol
        self._protocol = protocol()
        self._reopen, self._reconnect_s = reopen, reconnect_s
        self._reading = threading.RLock()
        """held by the thread that reads from the port, writes to it, or replaces it"""
        self._stop = SignalSafeEvent()
        self._has_frames = False
        """a frame has come since the board was last asked"""
        self._settled = False
        """the board is known and there, and need not be asked for each frame"""
        self._absence: Absence | None = None
        self._read_at = 0.0
        """when the port was last read, on its own clock"""
        self._received, self._reason = 0, "no end of a packet"
        """bytes since the last frame, and why the last of them formed no packet"""
        self._orders: list[PendingOrder] = []
        self._asked_at = inf
        """when the board was first asked who it is"""
        self._stopped = False
        """the board was ordered to send no frames"""
        self._unreadable = ""
        """why the description that the board has sent cannot be read"""
        self._forgotten = False
        """nobody holds the skin any more"""
        self._is_ending = False
        self._thread = threading.Thread(target=self._run, name=f"ohmskin reader {port.name}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        _CONNECTIONS.add(self)
        self._thread.start()

    def await_handshake(self, timeout_s: float) -> None:
        """Wait until the board has sent everything that the driver needs to know about it.

        Only the board's silence counts, not the time until the thread runs and has asked, on a busy machine.

        Raises:
            LinkTimeout: the board is silent.
            ProtocolError: the board sends something other than packets, or a description beyond the limits.
            InputError: the given design does not match this board.
            LinkError: the port is gone.

        """
        while not self.known.wait(min(ASK_AGAIN_S / 2, timeout_s)):
            if time.monotonic() - self._asked_at < timeout_s:
                continue
            self.poll(patient=True)
            if not self.known.is_set():
                raise self.nothing_came("description", timeout_s)
        if not self.handshake.complete:
            raise LinkError(f"{self.port_name}: closed") if self.frames.end is None else self.frames.end

    def serial_number(self, timeout_s: float) -> str:
        """Wait for the board's serial number; empty if it has none, or does not send it in time."""
        if self._family.has_description and self.frames.end is None:
            self.handshake.identified.wait(min(timeout_s, threading.TIMEOUT_MAX))
        return self.handshake.serial_number

    def nothing_came(self, what: str, timeout_s: float) -> LinkTimeout | ProtocolError:
        """The error for a wait for ``what`` that timed out."""
        where = f"{self.port_name}: no {what} within {max(timeout_s, 0.0):g} s"
        if self.frames.is_full():
            return LinkTimeout(f"{where}: the queue is full of frames for another reader of this skin, who takes none")
        if self.frames.away is not None:
            return LinkTimeout(f"{where}: {self.frames.away}; trying to open the port again")
        if self._unreadable and not self.handshake.complete:
            return ProtocolError(f"{where}: the board describes itself wrongly: {self._unreadable}")
        if not self._received:
            last = self.frames.newest
            if last is None:
                return LinkTimeout(
                    f"{where}: the port is silent; `ohmskin doctor {self.port_name}` asks in the ways of other boards"
                )
            return LinkTimeout(
                f"{where}: nothing came since the last frame, {self.now() - last.monotonic_time:.3g} s ago"
            )
        if self._reason:
            layout = self._protocol.layout
            size = "" if self._family.has_description else f" with {layout.rows} x {layout.columns} cells"
            return ProtocolError(
                f"{where}: {self._received} bytes came, {looks_of(self._sample, self._sent)}, the last of them no "
                f"packet ({self._reason}); expected a board of family '{self._family.name}'{size}, at this baud rate; "
                f"`ohmskin doctor {self.port_name}` says which board it is, or drafts its description"
            )
        return LinkTimeout(f"{where}: the board is there, but sends none")

    def poll(self, *, patient: bool = False) -> None:
        """Read the bytes that have come, and convert their frames.

        Errors of the port are left to the thread, and so are bytes of a flood. Before a time-out is reported, whoever
        waits is ``patient``: a thread that reads may be kept from it by other programs.
        """
        self._read_for_consumer(CLOSE_S if patient else POLL_S)
        if self._clock() - self._read_at > READ_AGAIN_S:
            self._read_for_consumer(POLL_S)

    def _read_for_consumer(self, limit_s: float) -> None:
        if self._reading.acquire(timeout=limit_s):
            try:
                self._read()
            except OhmskinError:
                return
            finally:
                self._reading.release()
        self.frames.catch_up()
        self.frames.wake()

    def now(self) -> float:
        """Present time on the port's clock."""
        return self._clock()

    def order(self, order: Order, timeout_s: float, *, period_us: int = 0) -> Answer | None:
        """Send an order to the board, again if need be, and wait for its answer.

        Returns:
            The answer; None at once if the family's orders have none.

        Raises:
            InputError: the family has no such order, or this is the thread that would hear the answer.
            OrderRefused: the board has refused the order.
            LinkTimeout: no answer came.
            LinkEnded: the skin is closed, or the stream is over.
            LinkError: the port is gone, or the line is full.

        """
        if threading.current_thread() is self._thread:
            raise InputError(f"{order.name} from within a function that is called with all bytes; give it elsewhere")
        pending, until_s = PendingOrder(order), time.monotonic() + timeout_s
        self._orders.append(pending)
        try:
            while True:
                with self._reading:
                    if not self.send(order, period_us=period_us):
                        raise InputError(
                            f"{self.port_name}: boards of family '{self._family.name}' take no {order.name}"
                        )
                    if not self._protocol.commands:
                        return None
                    pending.numbers.add(self._protocol.commands)
                left_s = until_s - time.monotonic()
                if pending.over.wait(min(max(left_s, 0.0), ASK_AGAIN_S)):
                    break
                if left_s <= 0:
                    raise LinkTimeout(f"{self.port_name}: no answer to {order.name} within {timeout_s:g} s")
        finally:
            self._orders.remove(pending)
        if pending.answer is None:
            raise copy.copy(self.frames.end or self._closed())
        answer = pending.taken(self.port_name, f" with {period_us} us" if order is Order.RATE else "")
        if order in (Order.STOP, Order.START):
            self._stopped = order is Order.STOP
        return answer

    def send(self, order: Order, *, period_us: int = 0) -> bool:
        """Send an order to the board; returns whether its family has such an order.

        Raises:
            LinkEnded: the skin is closed, or the stream is over.
            LinkError: the port is gone, or the line is full.

        """
        with self._reading:
            if self.frames.end is not None:
                raise copy.copy(self.frames.end)
            if self._port is None:
                raise LinkError(f"{self.port_name}: the board is away")
            data = self._protocol.request(order, period_us=period_us)
            if data:
                self._port.write(data)
                self._sent = data
            return bool(data)

    @contextlib.contextmanager
    def between_arrivals(self) -> Iterator[None]:
        """Read no bytes within the block."""
        with self._reading:
            yield

    @property
    def away(self) -> bool:
        """Whether the port is gone at present, or the board there has yet to show that it is the one from before."""
        return self._absence is not None

    def hear_before(self, introduction: bytes) -> None:
        """Take what the board said of itself before a recording that plays began. Call before :meth:`start`.

        Raises:
            ProtocolError: the board's identity or description exceeds the limits.

        """
        for event in self._new_protocol().feed(introduction, 0.0):
            if isinstance(event, Identity | Description):
                self.handshake.add(event)

    def disown(self) -> None:
        """In a forked process: leave port and mailbox to the parent process, which opened them."""
        self._reading, self._port = threading.RLock(), None
        self._stop = SignalSafeEvent()
        self.frames.disown(
            LinkError(
                f"{self.port_name}: was opened by process {os.getppid()}, from which this one was forked; take frames "
                "there, or open the skin here (multiprocessing: start method 'spawn')"
            )
        )

    def stop(self) -> None:
        """End the thread, which closes the port. May be called from another thread or from a callback."""
        self._is_ending = True
        self._stop.set()
        port = self._port
        if port is not None:
            port.interrupt()
        self.frames.close(self._closed())
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(CLOSE_S if port is None else RELEASE_S)

    def _closed(self) -> LinkEnded:
        return LinkEnded(f"{self.port_name}: the skin is closed")

    def forget(self) -> None:
        """Nobody can take frames any more: let the thread end within half a second, unless, and until, nobody taps it.

        This is for destructors. It takes no lock, because the garbage collector may run in a thread that holds the
        lock.
        """
        self._forgotten = True
        self._is_ending = self._is_ending or not self.taps

    def record(self, recording: Recording) -> None:
        """Give a recording all bytes from now on, until it is closed."""
        self.recordings[recording], recording.leave = None, partial(self._leave, recording)
        self.taps.append(recording.arrived)

    def record_frames(self, recording: Recording, receive: Callable[[RawFrame, Converted], None]) -> None:
        """Give a recording all converted frames, too; the board is known."""
        self.recordings[recording] = receive
        self.frames.on_converted.append(receive)
        self.frames.converter.on_rest.append(recording.rest_changed)

    def _leave(self, recording: Recording) -> None:
        with self._reading:
            receive = self.recordings.pop(recording)
            self.taps.remove(recording.arrived)
            if receive is not None:
                self.frames.on_converted.remove(receive)
                self.frames.converter.on_rest.remove(recording.rest_changed)
            self._is_ending = self._is_ending or (self._forgotten and not self.taps)

    def _run(self) -> None:
        try:
            self._live()
        except OhmskinError as error:
            self.frames.finish(self._closed() if self._is_ending else error)
        finally:
            # stop() may have woken this thread before telling the consumers.
            ended = LinkError(f"{self.port_name}: the reader thread has ended")
            self.frames.finish(self._closed() if self._is_ending else ended)
            self._release()
            self._reopen = None  # its finder watches a file, the port's announcement
            self.known.set()
            self.handshake.identified.set()
            for pending in list(self._orders):
                pending.over.set()

    def _live(self) -> None:
        """Serve the port, and again after each reconnection."""
        while not self._is_ending:
            try:
                self._serve()
                return
            except LinkEnded:
                raise
            except LinkError as error:
                if self._is_ending or self._reopen is None or not self.known.is_set():
                    raise
                self._release()
                for recording in tuple(self.recordings):
                    recording.port_gone()
                self._connect_again(error)

    def _serve(self) -> None:
        """Read the port until it ends."""
        port = self._port
        assert port is not None
        if self.handshake.complete:
            self.known.set()
        self._ask()
        self._asked_at = min(self._asked_at, time.monotonic())
        ask_at = time.monotonic() + ASK_AGAIN_S / 2
        again_s = self._family.repeat_start_s or inf
        again_at = time.monotonic() + again_s
        behind = False
        while not (self._is_ending or self.frames.end):
            if self._is_full():
                self.frames.wait_for_room(ASK_AGAIN_S)
                ask_at = time.monotonic() + ASK_AGAIN_S
                continue
            if port.wait(0.0 if behind else min(ask_at, again_at) - time.monotonic()):
                began = time.monotonic()
                if self._read():
                    # Half of the interpreter's time is left to others, who may be setting up the circuit's inverse.
                    self._stop.wait(min(time.monotonic() - began, LONGEST_REST_S))
            behind = self.frames.keep_up()
            now = time.monotonic()
            if self._absence is not None and now > self._absence.proof_until_s:
                raise LinkError(f"{port.name}: the board there does not show that it is the one from before")
            known = self.known.is_set() and self._absence is None
            if known and now >= again_at:
                self._start_frames()
                again_at = now + again_s
            if self._has_frames and known:
                ask_at, self._has_frames = now + ASK_AGAIN_S, False
            elif now >= ask_at:
                self._ask()
                ask_at = now + (ASK_AGAIN_S if known else ASK_AGAIN_S / 2)

    def _is_full(self) -> bool:
        """Whether no frame can be taken. An answer lies behind frames, hence some more are taken until it comes."""
        return self.frames.is_full(ANSWER_LIES_BEHIND if self._orders else 1)

    def _ask(self) -> None:
        try:
            for order in (Order.IDENTIFY, Order.DESCRIBE):
                self.send(order)
            if self.handshake.complete and not (self._absence and self._absence.unproven):
                self._start_frames()
        except LinkError:
            self._read()  # bytes from before the loss, and the reason of the loss
            raise

    def _start_frames(self) -> None:
        """Order frames once the board is known, so that a board that waits for orders sends no unusable frames."""
        if self._stopped:
            return
        self.send(Order.START)
        if self._family.polled:
            self.send(Order.ONE_FRAME)

    def _read(self) -> bool:
        """Read what has come, within the budget of a turn; whether the thread shall rest before it goes on."""
        done, until_s, frames = 0, 0.0, self.frames
        try:
            with self._reading:
                while not (self._port is None or self._is_ending or (frames.lossless and self._is_full())):
                    arrival = self._port.read()
                    self._read_at = arrival.received_at
                    if not arrival.data:
                        break
                    came = self._take(arrival)
                    # Another frame may have come while several were decoded; it would be the newest one.
                    if not arrival.more and came <= 1:
                        break
                    done, now_s = done + came, time.thread_time()
                    until_s = until_s or now_s + LONGEST_TURN_S
                    if done >= MANY or now_s > until_s:
                        return not frames.lossless
        except OhmskinError:
            raise
        except Exception as error:
            # No reader shall wait for frames that no longer come.
            frames.finish(LinkError(f"{self.port_name}: reading failed: {error!r}"))
            raise
        return False

    def _take(self, arrival: Arrival) -> int:
        """Take bytes that have come; returns how many packets they complete."""
        self._received += len(arrival.data)
        for tap in self.taps:
            tap(arrival)
        if self.frames.newest is None:
            self._sample = (self._sample + arrival.data)[-SAMPLE_BYTES:]
        events = self._protocol.feed(arrival.data, arrival.received_at)
        frames = 0
        for event in events:
            frames += event.__class__ is FramePacket
        self.stream.arrive(arrival, frames)
        for event in events:
            if self._settled and event.__class__ is FramePacket and not self._orders:  # the usual case
                self._reason, self._has_frames = "", True
                self._add_frame(event, arrival)
            else:
                self._handle(event, arrival)
        return len(events)

    def _handle(self, event: Event, arrival: Arrival) -> None:
        self._reason = ""
        for pending in self._orders:
            pending.hear(event)
        match event:
            case FramePacket():
                self._has_frames = True
                self._receive(event, arrival)
                if self._family.polled:
                    self.send(Order.ONE_FRAME)
            case Identity() | Description():
                self._identify(event)
            case Corrupt():
                self._reason = event.reason
                if event.is_description:
                    self._unreadable = event.reason
                self.frames.counters.corrupt += 1
                self.frames.counters.why_corrupt = event.reason

    def _receive(self, packet: FramePacket, arrival: Arrival) -> None:
        if not self.handshake.complete:
            self._learn(packet)
            if not self.handshake.complete:
                following = None if packet.sequence is None else (packet.sequence + 1) % 2**32
                self.stream.announce(following, packet.boot_id)
                return
        if self._absence is not None:
            if self._absence.unproven:
                self._absence.waiting.append((packet, arrival))
                return
            # A board that sends no identity is identified by its port alone.
            self._prove()
        self._settled = not self._family.polled
        self._add_frame(packet, arrival)

    def _add_frame(self, packet: FramePacket, arrival: Arrival) -> None:
        try:
            frame = self.stream.add(packet, arrival)
        except ProtocolError as error:
            self.frames.report(error)
            return
        self._received = 0
        if frame is not None:
            self.frames.put(frame)
        if packet.flags is not _NO_FLAGS and packet.flags & Flag.LAST:
            self._finish()

    def _finish(self) -> None:
        """End the stream: the board has announced that no frame follows."""
        unknown = "" if self.handshake.complete else ", and has not described itself before"
        self.frames.finish(LinkEnded(f"{self.port_name}: the board has come to the end of its frames{unknown}"))
        assert self._port is not None
        self._port.interrupt()

    def _identify(self, event: Identity | Description) -> None:
        """Take the board's identity or description; after a reconnection, compare it with the earlier one.

        Raises:
            LinkError: another board is there, or the board has changed since the skin was opened.
            ProtocolError: the board that is being opened contradicts itself, or exceeds the limits.
            InputError: the given design does not match the board that is being opened.

        """
        absence = self._absence
        first_frame_is_near = absence is None or not absence.waiting
        if absence is not None:
            difference = self.handshake.difference(event)
            if difference:
                raise LinkError(f"{self.port_name}: {difference}")
            absence.unproven.discard(type(event))
            if not absence.unproven:
                self._prove()
                self._start_frames()
        if isinstance(event, Identity) and event.over:
            self.stream.end(event.sequence, event.boot_id, event.time_us)
            self._finish()
            return
        self._learn(event)
        if first_frame_is_near:
            self.stream.announce(event.sequence, event.boot_id)

    def _learn(self, event: Identity | Description | FramePacket) -> None:
        """Pass a packet to the handshake; errors as for :meth:`_identify`."""
        known = self.handshake.complete
        try:
            self.handshake.add(event)
        except (ProtocolError, InputError) as error:
            # Readers of an open skin go on after ProtocolError and InputError; this error is final, hence LinkError.
            final = LinkError(str(error)) if known else error
            self.frames.finish(final)
            raise final from error
        if self.handshake.complete and not known:
            self._start_frames()
            self.known.set()

    def _prove(self) -> None:
        """The board has proved that it is the one from before."""
        absence, self._absence = self._absence, None
        assert absence is not None
        self.port_name = self.handshake.port_name
        self.frames.counters.reconnects += 1
        self.frames.counters.times_s.clear()
        self.frames.set_away(None)
        for packet, arrival in absence.waiting:
            self._add_frame(packet, arrival)

    def _connect_again(self, error: LinkError) -> None:
        """Open the port again; LinkError if it has not come back in time."""
        assert self._reopen is not None
        before = self._absence
        if before is None:
            before = Absence(time.monotonic(), error)
            self.frames.set_away(str(error))
        absence, self._settled = Absence(before.since_s, before.because), False
        self._absence = absence
        left_s = self._reconnect_s - (time.monotonic() - absence.since_s)
        failure: LinkError | None = None
        for _ in attempts(left_s, lambda wait_s: self._stop.wait(wait_s) or self._is_ending):
            try:
                port = self._reopen()
            except LinkEnded:
                raise
            except LinkError as again:
                failure = again
                continue
            with self._reading:
                self._port, self._clock = port, port.now
                self.handshake.port_name = port.name
                self._protocol, self._stopped = self._new_protocol(), False
                for pending in self._orders:
                    pending.numbers.clear()
                known = self.handshake.identity, self.handshake.description
                absence.unproven = {type(packet) for packet in known if packet is not None}
                absence.proof_until_s = time.monotonic() + GONE_S
            return
        # "A board was found and refused" is more informative than "the port is not there".
        found = failure if str(error) == str(absence.because) else error
        because = "" if found is None else f" ({found})"
        raise LinkError(f"{absence.because}; it has not come back within {self._reconnect_s:g} s{because}")

    def _release(self) -> None:
        with self._reading:
            if self._port is not None:
                self._port.close()
                self._port = None


_CONNECTIONS: weakref.WeakSet[Connection] = weakref.WeakSet()
"""started by this process"""
