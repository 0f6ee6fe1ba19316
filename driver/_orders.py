"""Orders to a board, and their answers, matched by the number of the order that a reply repeats."""

from __future__ import annotations

from ..common.events import SignalSafeEvent
from ..errors import OrderRefused
from ..wire import Corrupt, Description, Event, FramePacket, Identity, Order, Reply, SelfTest, Status

Answer = FramePacket | Identity | Description | SelfTest | Reply
"""what a board sends in answer to an order"""
_PACKETS: dict[Order, type[Answer]] = {
    Order.DESCRIBE: Description,
    Order.IDENTIFY: Identity,
    Order.ONE_FRAME: FramePacket,
    Order.SELF_TEST: SelfTest,
}
"""answers that carry no number of an order; all other orders are answered by a Reply"""
_WHY = {
    Status.UNKNOWN_ORDER: "it does not know this order",
    Status.BAD_PAYLOAD: "its version of this order has another length",
    Status.OUT_OF_RANGE: "the value is out of its range",
    Status.NOT_NOW: "it is busy; ask again",
    Status.NOT_SUPPORTED: "it has no such part",
    Status.WRONG_VERSION: "it speaks another version of the protocol",
}


class PendingOrder:
    """An order whose answer has not come. It may have been sent several times, since lines lose packets."""

    def __init__(self, order: Order) -> None:
        self.order = order
        self.numbers: set[int] = set()
        """under which it was sent over the present connection"""
        self.answer: Answer | None = None
        self.over = SignalSafeEvent()
        """set when the answer has come, or when none will come"""

    def hear(self, event: Event) -> None:
        """Take a packet of the board, which may be the answer."""
        if isinstance(event, Reply):
            if event.order != self.order.value or event.command_sequence not in self.numbers:
                return
        elif isinstance(event, Corrupt) or not isinstance(event, _PACKETS.get(self.order, ())):
            return
        self.answer = event
        self.over.set()

    def taken(self, port_name: str, value: str = "") -> Answer:
        """The answer; OrderRefused if the board has refused the order with this ``value``."""
        answer = self.answer
        assert answer is not None
        if isinstance(answer, Reply) and answer.status is not Status.TAKEN:
            why = _WHY[answer.status]
            raise OrderRefused(f"{port_name}: the board refuses {self.order.name}{value}: {why}", answer.status.name)
        return answer
