"""The live path: freshness, losses told apart, ends, reconnection, and readers of every kind."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import os
import pty
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, WHAT, Flow, Script, described, frame, gone, identity, lossless, scene, sheet, until
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.circuits import Design
from ohmskin.common.config import parse
from ohmskin.driver import Arrival, BytePort, CountReader, Delivery, Frame, Skin, SocketPort, Tare, discover
from ohmskin.emulator import Board, PtyPort, running
from ohmskin.errors import InputError, LinkEnded, LinkError, LinkTimeout, ProtocolError
from ohmskin.wire import (
    BOARDS,
    DescriptionPiece,
    Flag,
    FramePacket,
    Layout,
    Order,
    encode,
    host_protocol,
    write_description,
)

SIX_FRAMES = [frame(k) for k in range(6)]


def sequences(frames: list[Frame]) -> list[int | None]:
    return [frame.sequence for frame in frames]


def busy_until(event: threading.Event, processor_s: float) -> None:
    """Work until the event, for at most so much processor time."""
    until_s = time.thread_time() + processor_s
    while not event.is_set() and time.thread_time() < until_s:
        sum(range(1000))


@contextlib.contextmanager
def taking(skin: Skin, how: str) -> Iterator[Callable[[], Frame]]:
    """One of the ways to take the next frame."""
    own = skin.frames()
    with asyncio.Runner() as runner:

        async def follow() -> AsyncIterator[Frame]:
            return aiter(skin)

        following = runner.run(follow())

        async def following_frame() -> Frame:
            return await anext(following)

        ways = {
            "latest": lambda: skin.latest(max_age=0.01),
            "read": lambda: skin.read(timeout=0.0),
            "iteration": lambda: next(skin),
            "frames": lambda: next(own),
            "async": lambda: runner.run(following_frame()),
        }
        yield ways[how]


class TestDelivery:
    """Who gets which frames, and what is said of the others."""

    def test_a_slow_reader_gets_the_newest_frame_and_the_number_of_those_it_missed(self) -> None:
        port = described(frame(0))
        with Skin(port) as skin:
            assert next(skin).sequence == 0
            port.say(b"".join(frame(k) for k in range(1, 500)))
            late = next(skin)
            assert (late.sequence, late.skipped_before, late.lost_before) == (499, 498, 0)
            port.say(frame(500), frame(510), frame(511))
            until(lambda: skin.stats().frames == 503)
            last = next(skin)
        assert (last.sequence, last.skipped_before, last.lost_before) == (511, 2, 9)
        assert skin.stats().lost == 9

    def test_every_frame_is_queued_and_what_overflows_is_counted(self) -> None:
        port = described()
        with Skin(port, delivery="every", queue=100) as skin:
            port.say(b"".join(frame(k) for k in range(150)))
            until(lambda: skin.stats().frames == 150)
            frames = [skin.read(0.0) for _ in range(100)]
            with pytest.raises(LinkTimeout):
                skin.read(0.0)
        assert sequences(frames) == list(range(50, 150))
        assert [f.skipped_before for f in frames] == [50] + 99 * [0]

    def test_readers_do_not_take_frames_from_each_other(self) -> None:
        port = described()
        with Skin(port, delivery="every", queue=1000) as skin:
            own, seen = skin.frames(), list[Frame]()
            skin.on_frame(seen.append)
            port.say(*(frame(k) for k in range(50)))
            mine, shared = list(islice(own, 50)), list(islice(skin, 50))
            until(lambda: len(seen) == 50)
        assert sequences(mine) == sequences(seen) == sequences(shared) == list(range(50))
        for one, another in zip(mine, shared, strict=True):
            assert one.pressure is another.pressure  # converted once, whoever asks

    def test_a_slow_policy_gets_all_frames_since_its_last_image(self) -> None:
        port = described(*(frame(k, us=10_000 * k) for k in (0, 1, 2, 4, 5)))
        with Skin(port) as skin:
            until(lambda: skin.stats().frames == 5)
            kept = skin.frames_since(0.0)
            assert sequences(kept) == [0, 1, 2, 4, 5]
            assert [one.lost_before for one in kept] == [0, 0, 0, 1, 0]
            since = skin.frames_since(kept[2].monotonic_time)
            assert sequences(since) == [4, 5]
            assert [one.lost_before for one in since] == [1, 0]
            np.testing.assert_array_equal(since[1].pressure, kept[4].pressure)
            assert skin.frames_since(kept[4].monotonic_time) == []
            assert next(skin).sequence == 5, "frames are not taken from other readers"
            skin.use_tare(Tare(np.full((3, 2), 9e3), np.ones((3, 2), bool), np.zeros((3, 2)), 1, 0, "A1", 0.0))
            port.say(frame(6, us=60_000))
            until(lambda: skin.stats().frames == 6)
            assert sequences(skin.frames_since(0.0)) == [6], "none from before a tare"
        with pytest.raises(LinkEnded):
            skin.frames_since(port.now())

    def test_async_iteration_gets_frames_and_ends_with_the_skin(self) -> None:
        port = described()

        async def follow(skin: Skin) -> list[Frame]:
            frames, following = [], aiter(skin)  # from now on
            threading.Timer(0.05, lambda: port.say(*(frame(k) for k in range(20)))).start()
            async for one in following:
                frames.append(one)
                if one.sequence == 19:
                    threading.Timer(0.05, skin.close).start()
            return frames

        with Skin(port, delivery="every") as skin:
            assert sequences(asyncio.run(follow(skin))) == list(range(20))

    def test_a_callback_that_fails_ends_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        failures: list[threading.ExceptHookArgs] = []
        monkeypatch.setattr(threading, "excepthook", failures.append)
        port = described()
        with Skin(port) as skin:
            skin.on_frame(lambda frame: 1 / 0)  # type: ignore[arg-type, return-value]
            port.say(frame(0))
            until(lambda: bool(failures))
            assert failures[0].exc_type is ZeroDivisionError
            assert next(skin).sequence == 0


class TestFreshness:
    """A frame says how old it is, and an old one is never given for a new one."""

    def test_a_stale_frame_is_refused(self) -> None:
        port = described(frame(0))
        with Skin(port) as skin:
            assert skin.latest(60.0, timeout=60.0).sequence == 0
            port.later_s = 100.0
            with pytest.raises(LinkTimeout, match=r"no frame younger than 0\.1 s: the newest frame is 1\d\d s old"):
                skin.latest(0.1)
            with Skin(described()) as new, pytest.raises(LinkTimeout, match="none came"):
                new.latest(1.0)
            again = skin.latest(300.0)
            assert (again.sequence, again.repeated) == (0, True)
            assert again.age > 100.0
            assert skin.latest(300.0) is again

    @pytest.mark.parametrize("deaf", [False, True], ids=["thread reads", "thread never runs"])
    @pytest.mark.parametrize("how", ["latest", "read", "iteration", "frames", "async"])
    def test_a_slow_reader_at_1_khz_gets_the_frame_that_came_last(self, how: str, deaf: bool) -> None:
        """On a clock of its own, hence on any machine: 10 ms of work per cycle."""
        port = Flow(identity() + sheet(), frame, 0.001, at_once=97)
        with Skin(port) as skin, taking(skin, how) as take:
            port.deaf = deaf
            total, true_ages = 0, []
            for _ in range(20):
                port.work(0.01037)
                newest = port.newest
                one = take()
                assert one.sequence is not None
                true_ages.append(port.time_s - 0.001 * (one.sequence + 1))
                total += 1 + one.skipped_before
                assert one.sequence >= newest
                assert one.lost_before == 0
            stated = skin.stats().age_s
        assert total == one.sequence + 1
        # The least delay that the clock map has seen is up to a part of a period, since frames are read in turns.
        np.testing.assert_allclose(list(stated.values()), np.percentile(true_ages, list(stated)), atol=0.0004)

    def test_slow_loops_see_the_pressures_of_a_loop_that_takes_every_frame(self) -> None:
        """The material remembers taps between the frames that a slow loop takes."""
        design = DESIGN | {"array": {"rows": 8, "columns": 8, "row_lead": 70.0}}
        taps = {"load_kpa": 10.0, "every_s": 0.31, "hold_s": 0.05, "rise_s": 0.01, "first_s": 0.5, "count": 4}
        tapped = {"bump": {"center_mm": [17.0, 13.0], "sigma_mm": 4.0}, "taps": taps}
        board = Board(
            scene(skin={"design": design}, contact=[tapped], board={"frame_rate": 100.0, "noise": 0.001}), seed=1
        )
        for order in (Order.IDENTIFY, Order.DESCRIBE, Order.START):
            board.receive(host_protocol("ohmskin").request(order))
        handshake = b"".join(board.answers())
        packets = [b"".join(board.tick()) for _ in range(241)]
        seen: dict[int, dict[int | None, np.ndarray]] = {}
        for rate_hz in (100, 20, 5):
            port = Flow(handshake, packets.__getitem__, 0.01, at_once=4096)
            with Skin(port, delivery="every") as skin:  # so that no frame is skipped, however slow this machine is
                port.deaf = rate_hz < 20  # whoever takes a frame then converts those before it
                seen[rate_hz] = {}
                for _ in range(240 * rate_hz // 100):
                    port.work(1 / rate_hz + 1e-9)
                    one = skin.latest(max_age=0.02)
                    seen[rate_hz][one.sequence] = one.pressure
                assert skin.stats().skipped == 0
        every = seen.pop(100)
        assert len(every) == 240
        for slow in seen.values():
            assert len(slow) >= 12
            for number, pressure in slow.items():
                np.testing.assert_array_equal(pressure, every[number])

    def test_what_happened_before_a_frame_is_told_once(self) -> None:
        """A control loop that adds up what it lost, and asks more often than frames come."""
        port = described(frame(0))
        with Skin(port) as skin:
            assert not skin.latest(60.0).repeated
            port.say(frame(3) + frame(4, flags=Flag.OVERRUN) + frame(6))
            told, again = skin.latest(60.0), skin.latest(60.0)
        assert (told.lost_before, told.skipped_before, told.overrun, told.repeated) == (3, 2, True, False)
        assert (again.lost_before, again.skipped_before, again.overrun, again.repeated) == (0, 0, False, True)
        assert again.pressure is told.pressure
        assert again.contacts == told.contacts

    def test_a_frame_as_a_dict_is_arrays_only(self) -> None:
        with Skin(described(frame(3))) as skin:
            one = next(skin)
        values = one.as_dict()
        assert all(isinstance(value, np.ndarray) for value in values.values())
        assert values["pressure"].shape == values["pressure_std"].shape == (3, 2)
        assert values["sequence"] == 3
        assert values["age"] > 0
        assert not any(name.startswith("_") for name in values)
        assert len(repr(one)) < 400


class TestEnds:
    """How a stream ends, and what is said then."""

    def test_the_last_frame_of_a_finite_board_ends_the_iteration(self) -> None:
        port = described(frame(0), frame(1, flags=Flag.LAST))
        with lossless(port) as skin:
            assert sequences(list(skin)) == [0, 1]
            assert list(skin) == []
            with pytest.raises(LinkEnded, match="the board has come to the end of its frames"):
                skin.read()

    def test_a_port_that_goes_away_is_an_error_with_its_reason(self) -> None:
        with lossless(described(frame(0), last=gone)) as skin:
            assert next(skin).sequence == 0
            for _ in range(2):
                with pytest.raises(LinkError, match="gone"):
                    next(skin)

    @pytest.mark.parametrize("delivery", ["newest", "lossless"])
    def test_closing_from_another_thread_ends_every_reader_quietly(self, delivery: str) -> None:
        with Skin(described(frame(0)), delivery=delivery) as skin:  # type: ignore[arg-type]
            next(skin)
            threading.Timer(0.1, skin.close).start()
            began = time.monotonic()
            assert list(skin) == []
            assert time.monotonic() - began < 30  # and not when the wait for a frame is over
            assert next(skin, None) is None
            assert list(skin.frames()) == []
            for ask in (skin.read, lambda: skin.latest(60.0), lambda: skin.tare(1)):
                with pytest.raises(LinkEnded, match="the skin is closed"):
                    ask()
            skin.close()


class TestDamage:
    """Duplicates, faults and overruns."""

    def test_after_a_fault_the_frames_go_on(self) -> None:
        pieces = [frame(5), encode(FramePacket.of(np.full((3, 2), 9), sequence=2, time_us=9000, boot_id=1)), frame(10)]
        with lossless(described(*pieces)) as skin:
            assert next(skin).sequence == 5
            with pytest.raises(ProtocolError, match="frame 2 came where 6 was next"):
                next(skin)
            after = next(skin)
        assert (after.sequence, after.lost_before) == (10, 7)

    @given(st.lists(st.sampled_from([*SIX_FRAMES, b"\0", b"junk\0", identity(), sheet()]), max_size=30))
    def test_every_frame_that_came_is_in_one_count(self, pieces: list[bytes]) -> None:
        def over() -> bytes:
            raise LinkEnded("over")

        port = described(*pieces, last=over)
        faults, taken = 0, []
        with Skin(port, delivery="lossless") as skin:
            while True:
                try:
                    taken.append(skin.read())
                except ProtocolError:
                    faults += 1
                except LinkEnded:
                    break
        stats = skin.stats()
        sent = sum(piece in SIX_FRAMES for piece in pieces)
        assert len(taken) == stats.frames
        assert stats.frames + stats.duplicates + stats.late + faults == sent
        assert stats.skipped == 0


class TestEveryFrameCounts:
    """Frames taken, skipped and lost add up to the frames that the board sent, whoever takes them and however."""

    @settings(max_examples=40)
    @given(
        delivery=st.sampled_from(["newest", "every", "lossless"]),
        queue=st.integers(1, 6),
        turns=st.lists(
            st.tuples(
                st.lists(st.integers(1, 4), max_size=5),
                st.sampled_from(["read", "latest", "tare", "refused tare", "nothing"]),
            ),
            max_size=12,
        ),
    )
    def test_of_one_reader(self, delivery: Delivery, queue: int, turns: list[tuple[list[int], str]]) -> None:
        """Between two turns frames come, each so many numbers after the one before."""
        port = described()
        number, account = 0, Account()

        def say(step: int) -> None:
            nonlocal number
            number += step
            port.say(frame(number - 1, level=[2000, 600]))  # unlike each other: a tare needs force

        def go_on() -> None:
            while not taken.wait(0.0005):
                say(1)

        with Skin(port, delivery=delivery, queue=queue, timeout=30.0) as skin:
            for steps, how in turns:
                for step in steps:
                    say(step)
                taken = threading.Event()
                coming = threading.Thread(target=go_on)
                if "tare" in how:
                    coming.start()
                with contextlib.suppress(LinkTimeout):
                    account.turn(skin, how)
                taken.set()
                if "tare" in how:
                    coming.join()
            say(1)
            while account.last != number - 1:
                account.turn(skin, "wait")
        assert account.total == number

    def test_of_readers_in_threads_and_in_the_event_loop(self) -> None:
        port = described()
        stop, began, accounts = threading.Event(), threading.Event(), [Account() for _ in range(4)]
        numbers = sorted(np.random.default_rng(1).choice(2000, 700, replace=False).tolist())

        async def follow(skin: Skin) -> None:
            following = aiter(skin)
            began.set()
            async for one in following:
                accounts[2].add(one)
                await asyncio.sleep(0.001)

        def together(skin: Skin) -> None:
            while not stop.is_set():
                with contextlib.suppress(LinkTimeout, LinkEnded):
                    accounts[0].add(skin.read(0.01))
                    accounts[0].add(skin.latest(60.0))

        port.say(frame(0))
        with Skin(port, timeout=60.0) as skin:
            accounts[0].add(next(skin))
            own = skin.frames()
            skin.on_frame(accounts[3].add)
            threads = [
                *(threading.Thread(target=together, args=(skin,)) for _ in range(2)),
                threading.Thread(target=lambda: [accounts[1].add(one) for one in own]),
                threading.Thread(target=lambda: asyncio.run(follow(skin))),
            ]
            for thread in threads:
                thread.start()
            assert began.wait(60)
            for k in numbers:
                port.say(frame(1 + k))
                if k % 7 == 0:
                    stop.wait(0.0005)
            port.say(frame(3000))
            until(lambda: all(account.last == 3000 for account in accounts))
            stop.set()
        for thread in threads:
            thread.join(20)
        assert [account.total for account in accounts] == [3001, 3000, 3000, 3000]
        assert skin.stats().lost == 3001 - 702


class Account:
    """What a reader adds up: frames that it took, and those that the frames say were lost or skipped."""

    def __init__(self) -> None:
        self.total = 0
        self.last: int | None = None
        self._lock = threading.Lock()

    def add(self, one: Frame) -> None:
        with self._lock:
            assert one.lost_before is not None
            self.total += one.lost_before + one.skipped_before + (not one.repeated)
            self.last = max(self.last or 0, one.sequence or 0)

    def turn(self, skin: Skin, how: str) -> None:
        """Take frames in one of the ways there are."""
        match how:
            case "read":
                self.add(skin.read(0.0))
            case "wait":
                self.add(skin.read())
            case "latest":
                self.add(skin.latest(60.0))
            case "tare":
                self.total += skin.tare(2, force=True).frames
            case "refused tare":
                with pytest.raises(InputError):
                    skin.tare(2)


class Bench:
    """A port that goes away and comes back on request: a cable to pull."""

    def __init__(self, *boards: Script) -> None:
        self.ports = list(boards)
        self.tries = 0

    def plug_in(self, port: Script) -> None:
        self.ports.append(port)

    def reopen(self) -> BytePort:
        self.tries += 1
        if not self.ports:
            raise LinkError("script: no such port")
        return self.ports.pop(0)


def test_a_description_that_was_lost_is_asked_for_again_while_frames_come() -> None:
    numbers = itertools.count()
    port = Script(identity(), last=lambda: frame(next(numbers)))
    asked = 0

    def lose_the_first(data: bytes) -> None:
        nonlocal asked
        if describe in data:
            asked += 1
            if asked == 2:
                port.say(sheet())

    describe = host_protocol("ohmskin").request(Order.DESCRIBE)[1:4]
    port.write = lose_the_first  # type: ignore[method-assign]
    with Skin(port, timeout=30.0) as skin:
        assert next(skin).sequence is not None
    assert asked >= 2


class TestReconnection:
    def test_the_next_frame_says_so_and_tare_and_estimator_are_kept(self) -> None:
        bench = Bench()
        first = described(*(frame(k) for k in range(6)), last=gone)
        with Skin(first, delivery="lossless", reopen=bench.reopen) as skin:
            rest = skin.tare(5)
            assert next(skin).sequence == 5
            bench.plug_in(Script(identity(boot_id=2), sheet(boot_id=2), frame(3, boot_id=2), frame(4, boot_id=2)))
            back, after = next(skin), next(skin)
            assert skin.tared is rest
        assert (back.sequence, back.lost_before) == (3, 3)
        assert (back.reconnected, back.rebooted, back.estimator_restarted) == (True, True, False)
        assert (after.reconnected, after.rebooted, after.estimator_restarted) == (False, False, False)
        np.testing.assert_allclose(back.pressure, 0.0, atol=1e-9)
        assert skin.stats().reconnects == 1

    def test_frames_that_come_before_the_board_has_shown_who_it_is_are_kept(self) -> None:
        bench = Bench(Script(frame(1), identity(), frame(2), sheet(), frame(3)))
        with Skin(described(frame(0), last=gone), delivery="lossless", reopen=bench.reopen) as skin:
            assert sequences(list(islice(skin, 4))) == [0, 1, 2, 3]

    def test_another_board_at_the_same_port_is_left_alone(self) -> None:
        another = Script(identity(serial_number="B2"), sheet(), frame(0))
        larger = Script(identity(rows=4), sheet(), frame(0))
        bench = Bench(another, larger, Script(identity(boot_id=3), sheet(boot_id=3), frame(9, boot_id=3)))
        with Skin(described(frame(0), last=gone), delivery="lossless", reopen=bench.reopen) as skin:
            assert sequences(list(islice(skin, 2))) == [0, 9]
        assert another.closed
        assert larger.closed

    def test_the_error_says_why_the_board_went_away_and_what_was_found_instead(self) -> None:
        bench = Bench(Script(identity(serial_number="B2"), sheet(), frame(0)))
        with Skin(described(frame(0), last=gone), reopen=bench.reopen, reconnect=0.3, timeout=30.0) as skin:
            next(skin)
            said = r"gone; it has not come back within 0\.3 s \(script: board B2 is there; expected A1\)"
            with pytest.raises(LinkError, match=said):
                next(skin)

    def test_a_skin_can_be_closed_while_the_board_is_away(self) -> None:
        with Skin(described(frame(0), last=gone), reopen=Bench().reopen, reconnect=1000.0) as skin:
            next(skin)
            until(lambda: skin.away is not None)
            with pytest.raises(LinkTimeout, match="trying to open the port again"):
                skin.latest(0.001)
            began = time.monotonic()
        assert time.monotonic() - began < 60

    def test_after_a_long_gap_the_estimator_starts_anew_and_the_frame_says_so(self) -> None:
        port = described(frame(0), frame(1))
        with lossless(port) as skin:
            frames = list(islice(skin, 2))
            port.later_s = 90.0
            port.say(frame(2, us=90_000_000, level=1500))
            frames.append(next(skin))
        assert [f.estimator_restarted for f in frames] == [True, False, True]
        fresh = WHAT.cell.estimator((3, 2)).step(1.0, frames[2].resistance)
        np.testing.assert_allclose(frames[2].pressure, fresh, rtol=1e-3)  # the skin has told the ADC steps
        remembers = WHAT.cell.estimator((3, 2))
        for gap_s, before in zip((1.0, 1.0, 90.0), frames, strict=True):
            remembered = remembers.step(gap_s, before.resistance)
        assert (np.abs(remembered - fresh) > 0.01 * fresh).all()

    def test_a_usb_board_is_known_by_its_number_and_found_under_another_name(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """As when a cable is pulled and put in again while its old name is still taken, here by another device."""
        names = listed_ports(monkeypatch)
        one, other = PtyPort(listed=False), PtyPort(listed=False)
        names[one.name] = "USB-1"
        with running(scene(), one):
            skin = Skin.open(serial_number="USB-1", reconnect=60.0, timeout=30.0)
            assert next(skin).sequence is not None
            names.clear()
        with skin, running(scene(), other):
            names[other.name] = "USB-1"
            assert next(frame for frame in skin if frame.reconnected).rebooted


def listed_ports(monkeypatch: pytest.MonkeyPatch) -> dict[str, str | None]:
    """Ports that the operating system lists from now on: name -> serial number of the USB device."""
    names: dict[str, str | None] = {}

    class Listed:
        def __init__(self, device: str) -> None:
            self.device, self.serial_number = device, names[device]

    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: list(map(Listed, names)))
    return names


class TestPorts:
    def test_a_terminal_window_is_not_written_to(self) -> None:
        """A link that an emulator left behind may lead to what is now somebody's terminal."""
        window, terminal = pty.openpty()
        name = os.ttyname(terminal)
        shell = "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); print(flush=True); input()"
        process = subprocess.Popen(
            [sys.executable, "-c", shell], stdin=terminal, stdout=subprocess.PIPE, start_new_session=True
        )
        os.close(terminal)
        try:
            assert process.stdout is not None
            process.stdout.readline()
            with pytest.raises(LinkError, match=rf"is the terminal of process {process.pid} \(.*\), not a board"):
                Skin.open(name)
            os.set_blocking(window, False)
            with pytest.raises(BlockingIOError):
                os.read(window, 100)
        finally:
            process.kill()
            process.communicate()
            os.close(window)

    def test_a_full_line_is_an_error_in_bounded_time(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = SocketPort("socket://{}:{}".format(*server.getsockname()))
            board, _ = server.accept()
            with board, pytest.raises(LinkError, match=r"the board takes no commands \(the line is full\)"):
                port.write(bytes(10**8))
            port.close()
            port.close()


class TestBoards:
    def test_taking_frames_leaves_nothing_to_the_garbage_collector(self) -> None:
        """So it never runs because of the driver, however long a program does (docs/notes/latency.md)."""
        port, numbers = described(), itertools.count()
        with lossless(port) as skin:

            def take(count: int) -> None:
                port.say(*(frame(next(numbers), level=2000 + k % 7) for k in range(count)))
                for one in islice(skin, count):
                    assert one.pressure_std.shape == (3, 2)
                    assert one.contacts is not None

            def left() -> int:
                gc.collect()
                take(100)
                return gc.collect()

            take(100)  # what is made once
            gc.disable()
            try:  # what frames leave is there each time; what another thread of this process left is not
                assert any(left() == 0 for _ in range(5))
            finally:
                gc.enable()

    def test_of_two_boards_with_one_serial_number_neither_is_guessed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        ports = [PtyPort() for _ in range(2)]
        listed_ports(monkeypatch).update(dict.fromkeys(port.name for port in ports))
        with running(scene(), ports[0]), running(scene(), ports[1]):
            number = discover()[0].serial_number
            with pytest.raises(LinkError, match=rf"2 boards with serial number {number}: at /dev/.*; give a port"):
                Skin.open(serial_number=number)

    def test_without_a_cell_there_are_ohms_and_no_pressure(self) -> None:
        family = replace(BOARDS["ohmskin"], has_description=False)
        with Skin(Script(frame(0)), board=family, design=WHAT.design) as skin:
            one = next(skin)
        assert skin.cell is None
        assert np.isfinite(one.resistance).all()
        assert np.isnan(one.pressure).all()
        assert one.contacts == ()

    @pytest.mark.parametrize(
        ("changes", "first", "said"),
        [
            ({"array": {"rows": 16}}, identity(), "the board has 3 x 2 cells, the design that was given has 16 x 2"),
            ({"array": {"rows": 16}}, frame(0), "the board has 3 x 2 cells, the design that was given has 16 x 2"),
            (
                {"adc": {"bits": 10}},
                identity(),
                "the board has a converter of 12 bits, the design that was given has one of 10",
            ),
        ],
    )
    def test_a_design_of_another_board_is_refused_when_the_skin_is_opened(
        self, changes: dict[str, Any], first: bytes, said: str
    ) -> None:
        port = Script(first)
        with pytest.raises(InputError, match=f"^script: {said}$"):
            Skin(port, design=WHAT.design.replace(**changes), cell=WHAT.cell, timeout=30.0)
        assert port.closed

    def test_the_first_frame_of_a_board_whose_design_and_cell_are_given_is_not_lost(self) -> None:
        with lossless(Script(frame(5), frame(6)), design=WHAT.design, cell=WHAT.cell) as skin:
            assert sequences(list(islice(skin, 2))) == [5, 6]

    def test_a_board_without_a_known_readout_has_counts_alone(self) -> None:
        family = replace(BOARDS["ohmskin"], has_description=False, layout=Layout(3, 2, 12))
        with lossless(Script(frame(0)), board=family) as skin:
            first = skin.read()
        assert not skin.knows_circuit
        assert first.valid.all()
        assert np.isnan(first.resistance).all()
        other = replace(family, layout=Layout(9, 9, 12))
        with lossless(Script(frame(0)), board=other) as skin, pytest.raises(ProtocolError, match="has 9 x 9"):
            skin.read()

    def test_a_polled_board_is_asked_for_every_frame_and_for_no_more_than_fit(self) -> None:
        port = described()
        answered = 0

        def answer(data: bytes) -> None:
            nonlocal answered
            if one_frame in data:
                port.say(frame(answered))
                answered += 1

        family = replace(BOARDS["ohmskin"], polled=True)
        one_frame = host_protocol(family).request(Order.ONE_FRAME)[1:4]
        port.write = answer  # type: ignore[method-assign]
        with Skin(port, board=family, delivery="lossless", queue=10) as skin:
            taken = sequences(list(islice(skin, 50)))
            assert np.diff(np.array(taken, dtype=float)).tolist() == [1.0] * 49
            assert taken[-1] is not None
            assert answered < taken[-1] + 100


def absurd(**changes: object) -> bytes:
    design, cell = WHAT.design.model_dump(), WHAT.cell.model_dump()
    for path, value in changes.items():
        table, key = path.split("__")
        (design if table in design else cell)[table][key] = value
    text = write_description(design, cell)
    return b"".join(
        encode(DescriptionPiece(0, 0, offset, len(text), text[offset : offset + 200], 1))
        for offset in range(0, len(text), 200)
    )


class TestDescriptions:
    """A description is what a another sent: it may be refused, and must not crash or stall the host."""

    @pytest.mark.parametrize(
        "changes",
        [
            {"array__row_lead": 1e31},
            {"array__row_lead": 1e-320},
            {"array__rows": 2**40},
            {"array__rows": 1000, "array__columns": 1000},
            {"array__rows": 64, "array__columns": 64, "array__sheet": "continuous"},
            {"model__etau2_kpa": 1e-320},
            {"model__eu1_kpa": 1e300},
            {"drive__voltage": 0.0},
            {"adc__bits": 2**62},
            {"array__sheet": "x" * 5000},
        ],
    )
    def test_absurd_values_are_protocol_errors(self, changes: dict[str, object]) -> None:
        began = time.monotonic()
        with pytest.raises(ProtocolError, match="script: the board describes"):
            Skin(Script(identity(), absurd(**changes), frame(0)), timeout=100.0)
        assert time.monotonic() - began < 90

    @pytest.mark.parametrize("error", [ZeroDivisionError, MemoryError])
    def test_what_nothing_can_be_computed_from_is_a_protocol_error(
        self, error: type[Exception], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(*_: object) -> None:
            raise error("no such thing")

        monkeypatch.setattr(CountReader, "__call__", fail)
        with pytest.raises(ProtocolError, match="the board describes itself wrongly: no such thing"):
            Skin(described())

    def test_the_timeout_covers_setting_up_the_circuit(self, monkeypatch: pytest.MonkeyPatch) -> None:
        released = threading.Event()

        def stall(*_: object) -> None:
            busy_until(released, 60.0)

        monkeypatch.setattr(CountReader, "__call__", stall)
        port = described(frame(0))
        began = time.monotonic()
        try:
            with pytest.raises(ProtocolError, match=r"was not set up within 0\.5 s"):
                Skin(port, timeout=0.5)
            assert time.monotonic() - began < 50
            assert port.closed
        finally:
            released.set()

    def test_a_board_that_changes_its_description_is_refused(self) -> None:
        other = parse(DESIGN | {"array": {"rows": 3, "columns": 2, "row_lead": 50.0}}, Design, source="design")
        text = write_description(other.model_dump(), WHAT.cell.model_dump())
        port = described(frame(0), encode(DescriptionPiece(1, 1, 0, len(text), text, 1)))
        with lossless(port) as skin:
            assert next(skin).sequence == 0
            with pytest.raises(LinkError, match="describes itself differently than before; open the skin again"):
                next(skin)


def test_taps_hear_every_byte_with_its_time() -> None:
    port = described()
    heard: list[Arrival] = []
    with Skin(port) as skin:
        skin.on_bytes(heard.append)
        port.say(frame(0), b"noise\0", frame(1))
        until(lambda: skin.stats().frames == 2)
    assert b"".join(arrival.data for arrival in heard) == frame(0) + b"noise\0" + frame(1)
    assert all(after.received_at >= before.received_at for before, after in itertools.pairwise(heard))


def test_an_unforeseen_failure_while_reading_is_not_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    port = described(frame(0))
    with Skin(port) as skin:
        next(skin)
        skin.on_bytes(lambda _: 1 / 0)  # type: ignore[arg-type, return-value]
        port.say(frame(1))
        with pytest.raises((LinkError, ZeroDivisionError)):  # the thread finds it, or the reader itself
            next(skin)
        with pytest.raises(LinkError, match="reading failed: ZeroDivisionError"):
            next(skin)
