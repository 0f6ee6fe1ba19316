"""The virtual board: a state machine over ticks and commands, without clock and without I/O.

States and commands (``docs/wire.md`` has the same table for firmware):

=========  ==========  =========  =============================  ==========================
state      START       STOP       ONE_FRAME                      RATE
=========  ==========  =========  =============================  ==========================
streaming  streaming   stopped    streaming (next frame answers)  streaming, at the new rate
stopped    streaming   stopped    one frame, then stopped        stopped, at the new rate
=========  ==========  =========  =============================  ==========================

IDENTIFY, DESCRIBE and SELF_TEST are answered in both states and change neither. Ticks pass in both: the skin lives on,
but a stopped board does not scan it. Of each command at most one answer waits to be sent, so that a host that floods
the board with commands gets fewer answers and cannot make the board grow.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .. import __version__
from ..wire import (
    BadCommand,
    BoardProtocol,
    Command,
    Flag,
    FramePacket,
    Identity,
    Order,
    Reply,
    SelfTest,
    Status,
    board_protocol,
    write_description,
)
from ._hand import Hand
from ._scene import Scene
from ._self_test import self_test
from ._skin import EmulatedSkin, FrameBlock, Sample

IDENTITY_PERIOD_US = 1_000_000
SHORTEST_PERIOD_US = 10
"""us between two frames; what a scene's fastest frame rate has"""


class Board:
    """A board that reads ``scene`` at its frame rate and speaks ``protocol``."""

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int = 0,
        boot_id: int = 1,
        duration_s: float = math.inf,
        protocol: BoardProtocol | None = None,
        record: Callable[[Sample], None] | None = None,
        hand: Hand | None = None,
        ahead: bool = False,
    ) -> None:
        """Switch the board on.

        Args:
            scene: skin, board and contacts.
            seed: for the noise of the converter.
            boot_id: number of this start of the board.
            duration_s: after which no frame comes any more; the one before says so.
            protocol: the board's end of the line; None: the native one.
            record: called with every frame that the board scans.
            hand: presses beside the scene's contacts.
            ahead: compute frames ahead in a thread, for who must send each frame in time.

        """
        self.scene = scene
        self._hand = hand
        self.protocol = board_protocol("ohmskin") if protocol is None else protocol
        self.streaming = self.streams_unasked
        self.orders = 0
        """commands taken so far that start or stop frames"""
        self.overrun = False
        """set by the sender when it had to drop a frame: the next one says so"""
        self.clear_to_send = True
        """handshake line, to which the model of a board pays no attention"""
        self.boot_id = boot_id
        self.duration_s = duration_s
        self._record = record
        self._skin = EmulatedSkin(scene, seed, ahead=ahead)
        self._period_us = 1e6 / scene.board.frame_rate
        self._booted_us = -round(1e6 * scene.clock.offset_s)
        """board time at which the time stamps begin with 0"""
        self._silent_until_us = 0
        """board time up to which the boot loader runs"""
        self._sequence = 0
        self._frames_wanted = 0
        self._latest = np.full(scene.skin.design.array.shape, scene.skin.cell.rest_resistance_ohm)
        """(rows, columns) ohm of the cells in the last frame"""
        self._next_identity_us = 0
        self._description = write_description(scene.skin.described_design.model_dump(), scene.skin.cell.model_dump())
        self._waiting: dict[int, Command | BadCommand] = {Order.DESCRIBE.value: Command(Order.DESCRIBE)}
        """commands to answer, by packet type"""

    @property
    def skin(self) -> EmulatedSkin:
        """What the board reads."""
        return self._skin

    @property
    def streams_unasked(self) -> bool:
        """Whether boards of this family send frames from power-up on."""
        return not self.protocol.family.polled

    @property
    def next_us(self) -> int:
        """Time of the next tick, in us since the start."""
        return self._skin.next_us

    @property
    def is_ready(self) -> bool:
        """Whether the next tick can be lived through at once; False: its frame is still being computed."""
        return self._skin.is_ready

    @property
    def wants_tick(self) -> bool:
        """Whether the host waits for frames."""
        return self.streaming or self._frames_wanted > 0

    def prepare(self) -> None:
        """Make ready, before a host may come, what would keep a first frame or a first press waiting."""
        self._skin.prepare()

    def tick(self) -> list[bytes]:
        """Live through the next tick; the packets to send, each one whole."""
        time_us = self.next_us
        if self._hand is not None:
            self._feel(self._hand, time_us)
        block, place = self._skin.read()
        if time_us < self._silent_until_us:
            return []
        packets = []
        if time_us >= self._next_identity_us:
            self._next_identity_us += IDENTITY_PERIOD_US
            packets.append(self._identify(time_us - self._booted_us))
        packets += self._answer(time_us - self._booted_us)
        if self.wants_tick:
            packets.append(self._send(block, place, time_us - self._booted_us))
        return [packet for packet in packets if packet]

    def _feel(self, hand: Hand, time_us: int) -> None:
        """Take a load that has changed, from this tick on."""
        pressure = hand.take_change()
        if pressure is not None:
            self._skin.press(pressure)
            hand.in_force((time_us - self._booted_us) / 1e6)

    def receive(self, data: bytes) -> None:
        """Take bytes of the host. Commands take effect at once; their answers wait for :meth:`answers`."""
        if self.next_us < self._silent_until_us:
            return  # the boot loader takes no commands
        for command in self.protocol.feed(data):
            if isinstance(command, Command):
                self._obey(command)
            kind = command.order.value if isinstance(command, Command) else command.order
            # Unknown packet types share one place, so that no more than a few answers ever wait.
            self._waiting[kind if isinstance(command, Command) else -1] = command

    def answers(self) -> list[bytes]:
        """The packets that answer the commands received since the last call."""
        return [packet for packet in self._answer(self.next_us - self._booted_us) if packet]

    def reset(self, *, boots_for_us: int = 0) -> None:
        """Start anew, as after a reset or a loss of power; the skin lives on.

        Args:
            boots_for_us: us for which the boot loader runs and the board is silent.

        """
        self.boot_id = (self.boot_id + 1) % 2**32
        self.streaming = self.streams_unasked
        self.overrun = False
        self._frames_wanted = 0
        self._sequence = 0
        self._booted_us = self.next_us
        self._next_identity_us = self.next_us
        self._silent_until_us = self.next_us + boots_for_us
        self._waiting = {Order.DESCRIBE.value: Command(Order.DESCRIBE)}
        if self._period_us != 1e6 / self.scene.board.frame_rate:
            self._period_us = 1e6 / self.scene.board.frame_rate
            self._skin.set_period(self._period_us)

    def _obey(self, command: Command) -> None:
        match command.order:
            case Order.START:
                self.streaming = True
                self.orders += 1
            case Order.STOP:
                self.streaming = False
                self._frames_wanted = 0
                self.orders += 1
            case Order.ONE_FRAME:
                self._frames_wanted = 1
                self.orders += 1
            case Order.RATE if command.period_us >= SHORTEST_PERIOD_US:
                self._period_us = float(command.period_us)
                self._skin.set_period(self._period_us)

    def _answer(self, time_us: int) -> list[bytes]:
        waiting, self._waiting = self._waiting, {}
        packets: list[bytes] = []
        for command in waiting.values():
            match command:
                case Command(order=Order.IDENTIFY):
                    packets.append(self._identify(time_us))
                case Command(order=Order.DESCRIBE):
                    packets += self.protocol.describe(
                        self._description, sequence=self._sequence, time_us=time_us, boot_id=self.boot_id
                    )
                case Command(order=Order.SELF_TEST):
                    packets.append(self._test(time_us))
                case Command(order=Order.ONE_FRAME):
                    pass  # the frame is the answer
                case Command(order=Order.RATE) if command.period_us < SHORTEST_PERIOD_US:
                    packets.append(self._reply(time_us, command.order.value, command.sequence, Status.OUT_OF_RANGE))
                case Command(order=order):
                    packets.append(self._reply(time_us, order.value, command.sequence, Status.TAKEN))
                case BadCommand():
                    packets.append(self._reply(time_us, command.order, command.sequence, command.status))
        return packets

    def _flags(self) -> Flag:
        flags = Flag.OVERRUN if self.overrun else Flag.NONE
        if self.next_us >= 1e6 * self.duration_s:
            flags |= Flag.LAST
        return flags

    def _send(self, block: FrameBlock, place: int, time_us: int) -> bytes:
        self._latest = block.resistance_ohm[place]
        if self._record is not None:
            self._record(block.sample(place, self._sequence))
        frame = FramePacket.of(
            block.counts[place], sequence=self._sequence, time_us=time_us, flags=self._flags(), boot_id=self.boot_id
        )
        self.overrun = False
        self._frames_wanted = max(self._frames_wanted - 1, 0)
        self._sequence = (self._sequence + 1) % 2**32
        return self.protocol.frame(frame)

    def farewell(self) -> bytes:
        """The packet that says that no frame follows; empty where the family has none."""
        return self._identify(self.next_us - self._booted_us, over=True)

    def _identify(self, time_us: int, *, over: bool = False) -> bytes:
        design = self.scene.skin.design
        assert design.adc is not None  # a scene is refused without one
        return self.protocol.identify(
            Identity(
                self._sequence,
                time_us,
                rows=design.array.rows,
                columns=design.array.columns,
                adc_bits=design.adc.bits,
                streaming=self.streaming and not over,
                period_us=min(round(self._period_us), 2**32 - 1),
                description_bytes=len(self._description),
                serial_number=self.scene.board.serial_number,
                firmware=f"ohmskin emulator {__version__}",
                boot_id=self.boot_id,
                over=over,
            )
        )

    def _test(self, time_us: int) -> bytes:
        rows, columns, references = self_test(
            self.scene.skin.design, self._latest, self.scene.board.reference_resistances
        )
        return self.protocol.self_test(SelfTest(self._sequence, time_us, rows, columns, references, self.boot_id))

    def _reply(self, time_us: int, order: int, command_sequence: int, status: Status) -> bytes:
        return self.protocol.reply(
            Reply(self._sequence, time_us, order, status, command_sequence, boot_id=self.boot_id)
        )
