"""The program of a reference board as a board in service, as the device drives it (:mod:`.._device`)."""

from __future__ import annotations

from collections.abc import Callable

from .._hand import Hand
from .._scene import Scene
from .._skin import Sample
from .._tuning import TICK_S
from ._board import FirmwareBoard


class FirmwareInService(FirmwareBoard):
    """A firmware board that passes time in ticks. Its own commands start and stop it; ``streaming`` lets time pass."""

    streams_unasked = True
    is_ready = True

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int,
        boot_id: int,
        duration_s: float,
        hand: Hand | None,
        record: Callable[[Sample], None] | None,
    ) -> None:
        """Switch the board on; arguments and errors as for :class:`FirmwareBoard`."""
        super().__init__(scene, seed=seed, boot_id=boot_id, hand=hand, record=record)
        self.streaming, self.overrun, self.orders = True, False, 0
        self._duration_s = duration_s
        self._begun = b""
        """the beginning of a packet whose end has not left the board"""

    @property
    def next_us(self) -> int:
        """Time of the next tick, in us since power-up."""
        return round(1e6 * self.time_s)

    @property
    def wants_tick(self) -> bool:
        """Whether board time may pass."""
        return self.streaming

    def tick(self) -> list[bytes]:
        """Let the program run for a tick; the packets whose ends it sent."""
        sent = self._begun + self.run(min(TICK_S, self._duration_s - self.time_s))
        *packets, self._begun = sent.split(b"\0")
        return [packet + b"\0" for packet in packets]

    def receive(self, data: bytes) -> None:
        """Pass bytes of the host on; the first let time pass."""
        if data:
            self.send(data)
            self.orders += 1
            self.streaming = True

    def answers(self) -> list[bytes]:
        """None: the program answers within its ticks."""
        return []

    def reset(self, *, boots_for_us: int = 0) -> None:
        """Not modelled: :func:`check_scene` refuses scenes in which the line resets the board."""
        raise NotImplementedError
