"""Orders through an open skin: each returns the board's own answer to it, or raises its refusal."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path

import pytest
from boards import MemoryPort, Wire, described, frame, scene, until

from ohmskin.driver import Arrival, Skin
from ohmskin.emulator import Board
from ohmskin.errors import InputError, LinkTimeout, OrderRefused
from ohmskin.wire import BOARDS, Description, Event, FramePacket, Identity, Order, Reply, SelfTest, Status


def board() -> Board:
    return Board(scene(board={"frame_rate": 1000.0, "reference_resistances": [1e4, 2e4]}))


class Relay(Wire):
    """Between host and board: what the board says arrives after ``behind`` further reads."""

    def __init__(self, behind: int) -> None:
        super().__init__(board())
        self._behind = behind
        self._under_way: deque[bytes] = deque()

    def next_bytes(self) -> bytes:
        self._under_way.append(super().next_bytes())
        return self._under_way.popleft() if len(self._under_way) > self._behind else b"\0"


@pytest.mark.parametrize("behind", [0, 300])
@pytest.mark.parametrize("delivery", ["newest", "every"])
def test_each_order_returns_the_answer_to_itself(delivery: str, behind: int) -> None:
    """However late those to the orders before it come."""
    with Skin(Relay(behind), delivery=delivery, timeout=60.0) as skin:
        for period_us in (0, 2000, 0, 3000):
            if not period_us:
                with pytest.raises(
                    OrderRefused, match="refuses RATE with 0 us: the value is out of its range"
                ) as raised:
                    skin.request(Order.RATE, period_us=period_us)
                assert raised.value.status == "OUT_OF_RANGE"
                continue
            reply = skin.request(Order.RATE, period_us=period_us)
            assert isinstance(reply, Reply)
            assert (reply.order, reply.status) == (Order.RATE.value, Status.TAKEN)
        answers: dict[Order, type[Event]] = {
            Order.IDENTIFY: Identity,
            Order.DESCRIBE: Description,
            Order.SELF_TEST: SelfTest,
            Order.ONE_FRAME: FramePacket,
        }
        for order, kind in answers.items():
            assert isinstance(skin.request(order), kind)
        identity = skin.request(Order.IDENTIFY)
        assert isinstance(identity, Identity)
        assert identity.period_us == 3000


def test_a_board_that_was_stopped_sends_nothing_until_it_is_started() -> None:
    port = Wire(board())
    with Skin(port, timeout=60.0) as skin:
        skin.request(Order.STOP)
        asked = len(port.written)
        until(lambda: len(port.written) > asked + 3)  # the driver asks whether the board is there, and for no frames
        assert not port.board.streaming
        skin.request(Order.START)
        last = skin.latest(1e9).sequence
        assert last is not None
        assert skin.read().sequence is not None


def test_an_answer_behind_a_queue_of_frames_comes() -> None:
    """Nobody takes frames of a skin that loses none, while its only reader waits for the answer."""
    port = Wire(board())
    with Skin(port, delivery="lossless", queue=4, timeout=60.0) as skin:
        skin.read()
        until(lambda: port.board.orders > 0)
        assert isinstance(skin.request(Order.RATE, period_us=5000), Reply)
        numbers = [skin.read().sequence for _ in range(20)]
    assert numbers == list(range(numbers[0] or 0, (numbers[0] or 0) + 20))


def test_an_order_without_an_answer_says_so() -> None:
    with Skin(described(frame(0))) as skin, pytest.raises(LinkTimeout, match=r"no answer to RATE within 0\.1 s"):
        skin.request(Order.RATE, period_us=1000, timeout=0.1)


def test_orders_that_cannot_be_given_are_refused_here(tmp_path: Path) -> None:
    path = tmp_path / "short.mcap"
    raised: list[BaseException] = []

    def tap(_: Arrival) -> None:
        with pytest.raises(InputError, match="elsewhere") as caught:
            skin.request(Order.START)
        raised.append(caught.value)

    with Skin(Wire(board()), record=path) as skin:
        skin.on_bytes(tap)
        until(lambda: bool(raised))
    with Skin.open(path) as replay, pytest.raises(InputError, match="a recording takes no orders"):
        replay.request(Order.START)
    with (
        Skin(MemoryPort(), board=BOARDS["m1616"], timeout=0.1) as skin,
        pytest.raises(InputError, match="boards of family 'm1616' take no RATE"),
    ):
        skin.request(Order.RATE, period_us=1000)


def test_a_skin_that_is_closed_ends_the_wait_for_an_answer() -> None:
    with Skin(described(frame(0))) as skin:
        timer = threading.Timer(0.05, skin.close)
        timer.start()
        with pytest.raises(OSError, match="closed"):
            skin.request(Order.SELF_TEST, timeout=600.0)
        timer.join()
