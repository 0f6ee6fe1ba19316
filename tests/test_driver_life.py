"""A skin on a robot: boards that end, restart and change, lines that lose packets, readers that block or never read."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import errno
import gc
import itertools
import multiprocessing
import os
import pickle
import re
import socket
import struct
import threading
import weakref
from collections.abc import AsyncIterator, Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import EXAMPLES, Script, Wire, described, frame, gone, identity, lossless, scene, sheet, until

from ohmskin.circuits import Design
from ohmskin.driver import Arrival, Delivery, Frame, Recorder, Skin, SocketPort, Tare, discover, open_port
from ohmskin.driver._clock import ClockMap
from ohmskin.driver._mailbox import Mailbox
from ohmskin.driver._port import DescriptorPort, OrderlyClose, UrlPort
from ohmskin.driver._statistics import Counters
from ohmskin.driver._stream import FrameStream, RawFrame
from ohmskin.emulator import Board, PtyPort, Rfc2217Port, TcpPort, running
from ohmskin.errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError
from ohmskin.wire import (
    Flag,
    FramePacket,
    Order,
    encode,
    host_protocol,
)

FORK = multiprocessing.get_context("fork")


def order(which: Order) -> bytes:
    """The bytes by which a command of this kind is known."""
    return host_protocol("ohmskin").request(which)[1:4]


def _numbered(
    stream: FrameStream, number: int, board_s: float, *, clock: bool = True, host_s: float | None = None
) -> RawFrame | None:
    """What a stream makes of a packet; the host's clock is the board's where nothing else is said."""
    came_s = board_s if host_s is None else host_s
    arrival = Arrival(b"", 50.0 + came_s, 50.0 + came_s)
    time_us = round(1e6 * board_s) if clock else None
    stream.arrive(arrival, 1)
    return stream.take(FramePacket.of(np.full((3, 2), 9), sequence=number, time_us=time_us, boot_id=1), arrival)


async def _first(skin: Skin, count: int) -> AsyncIterator[Frame]:
    async for one in skin:
        yield one
        count -= 1
        if not count:
            return


def take_all(skin: Skin, how: str) -> int:
    """Frames to the end, taken in one of the ways there are; raises what the reader raises."""

    async def follow() -> int:
        return len([one async for one in skin])

    match how:
        case "iteration":
            return len(list(skin))
        case "frames":
            return len(list(skin.frames()))
        case "async":
            return asyncio.run(follow())
        case "callback":
            taken: list[Frame] = []
            ends: list[OhmskinError] = []
            skin.on_frame(taken.append, ends.append)
            until(lambda: bool(ends))
            assert isinstance(ends[0], LinkEnded)
            return len(taken)
    read: list[Frame] = []

    def read_on() -> None:
        while True:
            read.append(skin.read())

    with pytest.raises(LinkEnded, match="end of its frames"):
        read_on()
    return len(read)


class TestOwners:
    """Who has a port, within one program."""

    def test_a_port_can_be_opened_again_as_soon_as_a_reader_learns_of_the_closing(self) -> None:
        port = PtyPort()
        with running(scene(), port):
            for _ in range(10):
                skin = Skin.open(port.name, timeout=30.0)
                closing = threading.Thread(target=skin.close)
                closing.start()
                list(skin)
                Skin.open(port.name, timeout=30.0).close()
                closing.join()

    def test_a_reader_thread_that_ends_before_the_takers_are_told_ends_them_quietly(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        skin = Skin(described(frame(0)), timeout=30.0)
        skin.read()
        close = Mailbox.close

        def late(mailbox: Mailbox, error: OhmskinError) -> None:
            skin._reader._thread.join(60.0)
            assert isinstance(mailbox.end, LinkEnded)
            close(mailbox, error)

        monkeypatch.setattr(Mailbox, "close", late)
        threading.Thread(target=skin.close).start()
        assert list(skin) == []

    def test_a_skin_that_nobody_holds_gives_its_port_back(self) -> None:
        """As when a cell of a notebook is run again."""
        port = PtyPort()
        with running(scene(), port):
            skin: Skin | None = Skin.open(port.name, timeout=30.0)
            assert skin is not None
            skin.read()
            said = f"{port.name}: in use by another program, or by another Skin of this one"
            with pytest.raises(LinkError, match=re.escape(said)):
                Skin.open(port.name, timeout=30.0)
            skin = None
            gc.collect()
            Skin.open(port.name, timeout=30.0).close()

    def test_a_recording_goes_on_though_nobody_holds_the_skin(self, tmp_path: Path) -> None:
        port, path = PtyPort(), tmp_path / "alone.mcap"
        with running(scene(board={"frame_rate": 400.0}), port):
            skin = Skin.open(port.name, timeout=30.0, record=path)
            reader, recording, held = skin._reader, skin.recorder, weakref.ref(skin)
            del skin
            gc.collect()
            assert held() is None
            until(lambda: reader.stream.counters.frames > 300)
            reader.stop()
        assert recording is not None
        recording.close()
        with Skin.open(str(path)) as replay:
            assert len(list(replay)) > 300

    @pytest.mark.parametrize("how", ["callback", "async", "frames", "iteration"])
    def test_a_skin_that_a_reader_needs_stays_open(self, how: str) -> None:
        port = PtyPort()
        with running(scene(board={"frame_rate": 400.0}), port, duration_s=1e6):
            if how == "callback":
                seen: list[Frame] = []
                calls = Skin.open(port.name, timeout=30.0).on_frame(seen.append)
                gc.collect()
                until(lambda: len(seen) >= 200)
                calls.close()
                del calls
            elif how == "async":

                async def follow() -> None:
                    following = aiter(Skin.open(port.name, timeout=30.0))
                    gc.collect()
                    for _ in range(200):
                        await anext(following)

                asyncio.run(follow())
            else:
                skin = Skin.open(port.name, timeout=30.0)
                frames = skin.frames() if how == "frames" else iter(skin)
                del skin
                gc.collect()
                assert len(list(islice(frames, 200))) == 200
                del frames
            gc.collect()
            Skin.open(port.name, timeout=30.0).close()


class TestFiniteBoards:
    """An emulation that is over says so, whatever the line does to its last frame."""

    @pytest.mark.parametrize("how", ["iteration", "frames", "async", "callback", "read"])
    def test_every_reader_of_a_board_at_the_fast_clock_ends_though_half_of_all_packets_are_lost(
        self, how: str, tmp_path: Path
    ) -> None:
        port = PtyPort() if how in ("iteration", "async") else TcpPort.at(":0")
        lossy = scene(line={"packet_loss": 0.5}, board={"frame_rate": 400.0})
        truth = tmp_path / "truth.npz"
        with (
            running(lossy, port, clock="fast", duration_s=0.5, seed=3, truth=truth),
            Skin.open(port.name, delivery="lossless", timeout=60.0) as skin,
        ):
            taken = take_all(skin, how)
            stats = skin.stats()
        until(truth.exists)
        with np.load(truth) as file:
            sent = len(file["sequence"])
        assert sent == 200
        assert stats.lost is not None
        assert 0 < stats.lost < sent
        assert (taken + stats.lost, stats.frames, stats.reboots, stats.reconnects) == (sent, taken, 0, 0)

    def test_what_the_line_lost_at_the_end_is_counted(self) -> None:
        pieces = [frame(0), frame(1), identity(sequence=5, over=True)]
        with lossless(described(*pieces)) as skin:
            assert len(list(skin)) == 2
        assert (skin.stats().frames, skin.stats().lost) == (2, 3)

    def test_a_reboot_that_the_line_hid_until_the_end_is_counted(self) -> None:
        pieces = [frame(0), frame(1), identity(2, sequence=4, over=True)]
        with lossless(described(*pieces)) as skin:
            assert len(list(skin)) == 2
        assert (skin.stats().lost, skin.stats().reboots) == (4, 1)

    def test_a_board_that_ended_before_it_described_itself_says_so(self) -> None:
        with pytest.raises(LinkEnded, match="come to the end of its frames, and has not described itself before"):
            Skin(Script(identity(), frame(0), identity(over=True)), timeout=30.0)

    def test_a_board_that_is_switched_off_has_not_come_to_its_end(self) -> None:
        """An emulator that is stopped may be started again."""
        port = PtyPort()
        with running(scene(), port, duration_s=1e6):
            skin = Skin.open(port.name, reconnect=0.2)
            next(skin)
        with skin, pytest.raises(LinkError, match=r"it has not come back within 0\.2 s"):
            list(skin)

    def test_a_board_in_this_process_is_not_started_again(self) -> None:
        """Its family has no packet for an end."""
        url = f"ohmskin://{EXAMPLES / 'fingers.toml'}?clock=fast&duration=1&board=fsr-array"
        design = EXAMPLES / "prototype.toml"
        with Skin.open(url, board="fsr-array", design=design, delivery="lossless", timeout=30.0) as skin:
            assert len(list(skin)) == 50
            with pytest.raises(LinkEnded, match="come to the end of its time"):
                skin.read()

    def test_a_board_is_told_to_start_once_it_is_known(self) -> None:
        """One that waits for orders, as at the fast clock, sends no frames that cannot be used."""
        port = Script(identity())
        opened: list[Skin] = []
        opening = threading.Thread(target=lambda: opened.append(Skin(port, timeout=30.0)))
        opening.start()
        until(lambda: sum(order(Order.DESCRIBE) in said for said in port.written) >= 3)
        assert not any(order(Order.START) in said for said in port.written)
        port.say(sheet())
        opening.join(30)
        assert any(order(Order.START) in said for said in port.written)
        opened[0].close()


class TestOrderOfPackets:
    """What is made of numbers and times that go back."""

    def test_packets_that_were_overtaken_are_dropped_and_counted(self) -> None:
        sent = [0, 1, 3, 2, 4, 6, 5, 7]
        with lossless(described(*map(frame, sent), identity(sequence=8, over=True))) as skin:
            taken = list(skin)
        stats = skin.stats()
        assert [one.sequence for one in taken] == [0, 1, 3, 4, 6, 7]
        assert [one.lost_before for one in taken] == [0, 0, 1, 0, 1, 0]
        assert (stats.late, stats.duplicates, stats.reboots, stats.frames + (stats.lost or 0)) == (2, 0, 0, 8)

    @pytest.mark.parametrize(("later", "reboots"), [(63, 0), (64, 1)])
    def test_a_packet_that_is_further_back_was_not_overtaken(self, later: int, reboots: int) -> None:
        sent = [0, *range(2, 2 + later), 1]
        with lossless(described(*map(frame, sent))) as skin:
            for _ in sent[:-1]:
                skin.read()
            with contextlib.suppress(LinkError):
                skin.read(0.01)
            stats = skin.stats()
        assert (stats.late, stats.reboots) == (1 - reboots, reboots)

    def test_a_clock_that_wraps_is_no_reboot(self) -> None:
        """Microseconds in 32 bits, which small microcontrollers have, wrap after 72 minutes."""
        start, wrap = 4_000_000, 2**32
        pieces = [frame(start + k, us=(wrap - 3500 + 1000 * k) % wrap) for k in range(8)]
        port = Script(identity(sequence=start), sheet(sequence=start), *pieces, identity(sequence=start + 8, over=True))
        with lossless(port) as skin:
            taken = list(skin)
        stats = skin.stats()
        assert len(taken) == 8
        assert not any(one.rebooted or one.lost_before or one.estimator_restarted for one in taken[1:])
        assert (stats.lost, stats.reboots, stats.clock_steps) == (0, 0, 1)
        assert all(later.monotonic_time >= sooner.monotonic_time for sooner, later in itertools.pairwise(taken))

    @pytest.mark.parametrize("seconds", [-1800, 0.2, 2.0, 3600])
    def test_a_clock_that_is_set_is_no_hour_under_load(self, seconds: float) -> None:
        """The estimator goes on, and no frame looks older or younger than it is; 20 frames are lost just before."""
        stream, ages, times = FrameStream("board", Counters()), [], []
        for k in (*range(79), *range(99, 200)):
            now_s = 100.0 + 0.01 * k
            us = 4_000_000_000 + 10_000 * k + (round(1e6 * seconds) if k >= 100 else 0)
            packet = FramePacket.of(np.full((3, 2), 9), sequence=k, time_us=us, boot_id=1)
            taken = stream.take(packet, Arrival(b"", now_s, now_s))
            assert taken is not None
            ages.append(now_s - taken.monotonic_time)
            times.append(taken.time_s)
        assert max(map(abs, ages)) < 1e-6
        steps = np.diff(times)
        assert steps.min() > 0.005
        assert steps.max() < 0.5
        assert stream.counters.reboots == stream.counters.late == 0
        assert stream.counters.lost == 20

    def test_time_that_flies_is_no_clock_that_was_set(self) -> None:
        """The emulator's fast clock, a second of the board per millisecond, with packets that are lost."""
        stream = FrameStream("board", Counters())
        numbers = [k for k in range(300) if k % 7 and not 100 < k < 180]
        for k in numbers:
            packet = FramePacket.of(np.full((3, 2), 9), sequence=k, time_us=1_000_000 * k, boot_id=1)
            taken = stream.take(packet, Arrival(b"", 0.001 * k, 0.001 * k))
        assert taken is not None
        assert taken.time_s == pytest.approx(numbers[-1] - numbers[0])
        assert stream.counters.clock_steps == 0

    @pytest.mark.parametrize("clock", [True, False])
    @pytest.mark.parametrize("ahead", [10**9, 50_000, -50_000, 2**31 + 7])
    def test_a_number_that_no_time_explains_is_no_loss(self, clock: bool, ahead: int) -> None:
        """One intact packet of a stream of 100 frames a second with another number; then the board counts on."""
        stream = FrameStream("board", Counters())
        numbers = [100_000 + k + (ahead if k == 60 else 0) for k in range(100)]
        taken = [_numbered(stream, number, 0.01 * k, clock=clock) for k, number in enumerate(numbers)]
        assert all(one is not None and one.lost == 0 for one in taken)
        assert (stream.counters.frames, stream.counters.resyncs, stream.counters.reboots) == (100, 2, 0)

    @pytest.mark.parametrize(("clock", "host_s"), [(True, 30.0), (True, 0.0), (False, 30.0), (False, 0.0)])
    def test_frames_lost_in_a_long_pause_are_counted(self, clock: bool, host_s: float) -> None:
        """Of thirty seconds, or of five of a board without a clock whose bytes waited in a buffer meanwhile."""
        stream, lost = FrameStream("board", Counters()), 3000 if clock or host_s else 500
        for k in range(100):
            _numbered(stream, k, 0.01 * k, clock=clock)
        board_s = 1.0 + 0.01 * lost
        last = _numbered(stream, 100 + lost, board_s, clock=clock, host_s=1.0 + host_s)
        assert last is not None
        assert (last.lost, stream.counters.resyncs) == (lost, 0)

    def test_a_board_ends_with_no_more_losses_than_it_can_have_sent(self) -> None:
        stream = FrameStream("board", Counters())
        for k in range(100):
            _numbered(stream, k, 0.01 * k)
        stream.end(10**9, 1, 1_010_000)
        assert stream.counters.lost == 0
        stream.end(103, 1, 1_030_000)
        assert stream.counters.lost == 3

    def test_a_board_whose_boot_id_never_changes_is_seen_to_start_anew(self) -> None:
        pieces = [*(frame(k) for k in range(100)), *(frame(k) for k in range(5)), identity(sequence=5, over=True)]
        with lossless(described(*pieces)) as skin:
            taken = list(skin)
        assert [k for k, one in enumerate(taken) if one.rebooted] == [100]
        assert (skin.stats().frames, skin.stats().lost, skin.stats().reboots) == (105, 0, 1)

    def test_frames_that_waited_for_their_board_to_be_known_are_in_order(self) -> None:
        """The board tells the number of its next frame while frames before that wait."""
        back = Script(identity(2), frame(0, boot_id=2), frame(1, boot_id=2), sheet(2, sequence=2), frame(2, boot_id=2))
        boards = [back]
        with Skin(described(last=gone), delivery="lossless", reopen=boards.pop, timeout=30.0) as skin:
            assert [next(skin).sequence for _ in range(3)] == [0, 1, 2]
            assert skin.stats().lost == 0

    @pytest.mark.parametrize("seconds", [0.2, 10.0, 3600.0])
    def test_a_clock_that_is_set_forward_makes_no_frame_older(self, seconds: float) -> None:
        clock, ages = ClockMap(), []
        for k in range(2000):
            device_s = 0.01 * k + (seconds if k > 1000 else 0.0)
            arrived_s = 50.0 + 0.01 * k + 0.0002
            ages.append(arrived_s - clock.add(device_s, arrived_s))
        assert max(ages) < 0.001
        assert min(ages) > -1e-9


class TestAnotherBoard:
    def test_a_board_that_changed_is_the_end_and_not_a_fault_of_one_frame(self) -> None:
        """A loop that asks again after each ProtocolError must come to an end."""
        wide = encode(FramePacket.of(np.full((4, 2), 9), sequence=0, time_us=0, boot_id=2))
        with lossless(described(frame(0), identity(2, rows=4), wide), reopen=None) as skin:
            next(skin)
            for _ in range(2):
                with pytest.raises(
                    LinkError, match="a board of 4 x 2 cells is there; expected 3 x 2; open the skin again"
                ):
                    next(skin)


class TestReaders:
    """Readers that block, never read, or are in another process."""

    @pytest.mark.parametrize("delivery", ["newest", "every", "lossless"])
    def test_a_program_of_callbacks_only_keeps_no_frames(self, delivery: Delivery) -> None:
        """Each call lets five more frames come, so that some are skipped and some wait."""
        port, numbers = described(), itertools.count()
        taken: list[int | None] = []

        def take(one: Frame) -> None:
            taken.append(one.sequence)
            port.say(*(frame(next(numbers)) for _ in range(5)) if len(taken) < 100 else ())

        with Skin(port, delivery=delivery, queue=10) as skin:
            skin.on_frame(take)
            port.say(frame(next(numbers)))
            until(lambda: len(taken) >= 100)
            assert len(skin._converter._measured) <= 11
        if delivery == "lossless":
            assert taken == list(range(len(taken)))

    def test_nothing_is_dropped_for_a_reader_that_begins_later_while_there_is_room(self) -> None:
        port = described(*(frame(k) for k in range(8)))
        seen: list[Frame] = []
        with Skin(port, delivery="lossless", queue=10) as skin:
            skin.on_frame(seen.append)
            until(lambda: len(seen) == 8)
            assert [next(skin).sequence for _ in range(8)] == list(range(8))

    def test_a_reader_that_stopped_is_named_to_the_one_that_waits_for_it(self) -> None:
        port = described(*(frame(k) for k in range(30)))
        with Skin(port, delivery="lossless", queue=10) as skin:
            next(skin)  # from now on frames are kept for this place
            skin._timeout = 0.2
            with pytest.raises(LinkTimeout, match="queue is full of frames for another reader of this skin"):
                list(skin.frames())

    def test_callbacks_that_close_the_skin_at_once_do_not_wait_for_each_other(self) -> None:
        port = described()
        skin = Skin(port)
        both = threading.Barrier(2)

        def stop(_: Frame) -> None:
            both.wait(30)
            skin.close()

        callbacks = [skin.on_frame(stop) for _ in range(2)]
        port.say(frame(0))
        for callback in callbacks:
            callback._thread.join(30)
            assert not callback._thread.is_alive()
        skin.close()

    def test_a_callback_that_waits_for_who_closes_does_not_hold_closing_up(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("ohmskin.driver._consumer.CLOSE_S", 0.1)
        port, called, closed = described(), threading.Event(), threading.Event()
        with Skin(port) as skin:
            callback = skin.on_frame(lambda _: (called.set(), closed.wait(60)))  # type: ignore[arg-type, return-value]
            port.say(frame(0))
            assert called.wait(30)
        closed.set()
        callback._thread.join(30)
        assert not callback._thread.is_alive()

    def test_the_end_is_told_to_callbacks_unless_they_were_closed(self) -> None:
        ends: list[OhmskinError] = []
        port = described(frame(0))
        with Skin(port) as skin:
            skin.on_frame(lambda _: None, ends.append)
            closed = skin.on_frame(lambda _: None, ends.append)
            closed.close()
            port._last = gone
            until(lambda: bool(ends))
        assert [str(error) for error in ends] == ["gone"]
        with Skin(described(frame(0))) as skin:
            skin.on_frame(lambda _: None, ends.append)
        assert len(ends) == 1

    def test_a_task_that_is_cancelled_while_a_frame_comes_ends(self) -> None:
        """As by asyncio.timeout(): a board of 400 Hz that keeps its reader alive for ever is no rare case."""

        async def cancel(with_frame: bool) -> bool:
            frames = aiter(skin)
            task = asyncio.ensure_future(anext(frames))  # type: ignore[arg-type]
            await asyncio.sleep(0.05)
            if with_frame:
                frames._event.set()  # type: ignore[attr-defined]
            task.cancel()
            await asyncio.wait([task], timeout=30.0)
            return task.cancelled()

        with Skin(described(frame(0)), timeout=60.0) as skin:
            next(skin)
            assert asyncio.run(cancel(with_frame=False))
            assert asyncio.run(cancel(with_frame=True))

    def test_several_event_loops_may_follow_one_skin(self) -> None:
        """One after the other and at the same time, each in a thread; none leaves anything behind."""
        taken: list[int] = []

        async def follow(count: int) -> None:
            numbers = [one.sequence or 0 async for one in _first(skin, count)]
            assert numbers == sorted(set(numbers))
            taken.append(len(numbers))

        with Skin(Wire(Board(scene())), delivery="every", timeout=60.0) as skin:
            threads = [threading.Thread(target=lambda: asyncio.run(follow(5))) for _ in range(3)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60)
            asyncio.run(follow(2))
            gc.collect()
            assert sorted(taken) == [2, 5, 5, 5]
            assert not skin._mailbox._wakers

    def test_a_refused_tare_takes_no_frames(self) -> None:
        with lossless(described(*(frame(k, level=[2000, 600]) for k in range(4)))) as skin:
            with pytest.raises(InputError, match="differ from the others"):
                skin.tare(2)
            assert skin.tared is None
            assert next(skin).sequence == 0
            skin.tare(2, force=True)
            after = next(skin)
            assert (after.sequence, after.skipped_before) == (3, 0)

    @pytest.mark.parametrize("kind", ["pty", "tcp", "rfc2217", "ohmskin"])
    def test_opening_again_and_again_leaves_no_thread_and_no_descriptor(self, kind: str) -> None:
        """Also where the body of the ``with`` raises, and where the family does not fit."""
        port = {"tcp": TcpPort, "rfc2217": Rfc2217Port}[kind].at(":0") if kind in ("tcp", "rfc2217") else PtyPort()
        name = f"ohmskin://{EXAMPLES / 'fingers.toml'}" if kind == "ohmskin" else port.name
        with running(scene(board={"frame_rate": 400.0}), port):
            for k in range(6):
                if k == 2:
                    before = threading.active_count(), len(os.listdir("/proc/self/fd"))
                with contextlib.suppress(ZeroDivisionError), Skin.open(name, timeout=60.0) as skin:
                    skin.read(60.0)
                    skin.on_frame(lambda _: None)
                    raise ZeroDivisionError
                with pytest.raises(InputError, match="no-such"):
                    Skin.open(name, design="no-such.toml")
            until(lambda: (threading.active_count(), len(os.listdir("/proc/self/fd"))) <= before)

    def test_a_forked_process_is_told_that_the_skin_is_not_its_own(self) -> None:
        with Skin(Wire(Board(scene()))) as skin:
            next(skin)
            skin.on_frame(lambda _: None)
            answers = FORK.SimpleQueue()

            def child() -> None:
                for ask in (skin.read, lambda: skin.latest(60.0), lambda: skin.tare(1), lambda: next(skin)):
                    try:
                        ask()
                    except LinkError as error:
                        answers.put(str(error))
                skin.stats()
                skin.close()
                answers.put("closed")

            process = FORK.Process(target=child)
            process.start()
            process.join(60)
            assert process.exitcode == 0
            said = [answers.get() for _ in range(5)]
            assert next(skin).sequence is not None
        assert all("from which this one was forked" in text for text in said[:4])
        assert said[4] == "closed"

    def test_a_frame_can_be_sent_to_another_process_and_a_skin_cannot(self) -> None:
        with lossless(described(frame(0), frame(3))) as skin:
            next(skin)
            one = next(skin)
            for other in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
                assert (other.sequence, other.lost_before, other.contacts) == (3, 2, one.contacts)
                assert abs(other.age - one.age) < 30
                for name in ("counts", "valid", "resistance", "pressure", "pressure_std"):
                    np.testing.assert_array_equal(getattr(other, name), getattr(one, name))
            with pytest.raises(TypeError, match="send its frames, or open it there"):
                pickle.dumps(skin)


class TestPorts:
    @pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="Linux only")
    @pytest.mark.parametrize("listening", [TcpPort, Rfc2217Port])
    def test_a_tcp_board_that_acknowledges_nothing_is_gone_after_seconds(self, listening: type[TcpPort]) -> None:
        """A cable pulled at the board's end is told to nobody: the kernel alone would try for a quarter of an hour."""
        with listening.at(":0") as board, running(scene(), board):
            port = open_port(board.name)
            assert isinstance(port, SocketPort | UrlPort)
            connection = port._socket if isinstance(port, SocketPort) else port._device._socket  # type: ignore[attr-defined]
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 3000
            port.close()

    @pytest.mark.parametrize("how", ["read", "write"])
    @pytest.mark.parametrize("orderly", [False, True])
    def test_how_a_connection_ended_is_told_again_and_again(self, how: str, orderly: bool) -> None:
        """The kernel tells of a reset once, to whoever reads or writes first, and then of an end in good order."""
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = SocketPort("socket://{}:{}".format(*server.getsockname()))
            board, _ = server.accept()
            board.sendall(b"last words")
            linger = struct.pack("ii", not orderly, 0)
            board.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            board.close()
            assert port.wait(60.0)
            if how == "write":
                with contextlib.suppress(LinkError):
                    for _ in range(100):  # the first one may be on its way when the answer comes
                        port.write(b"who are you?")
            heard, errors = b"", list[LinkError]()
            while len(errors) < 3:
                try:
                    heard += port.read().data
                except LinkError as error:
                    errors.append(error)
            port.close()
        assert heard == b"last words"
        assert {isinstance(error, OrderlyClose) for error in errors} == {orderly}

    def test_too_many_open_files_are_one_message_and_leave_nothing_open(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail() -> None:
            raise OSError(errno.EMFILE, "Too many open files")

        terminal = PtyPort()
        with terminal, socket.create_server(("127.0.0.1", 0)) as server:
            descriptors = len(os.listdir("/proc/self/fd"))
            monkeypatch.setattr("ohmskin.driver._port.os.pipe", fail)
            for name in (terminal.name, "socket://{}:{}".format(*server.getsockname())):
                with pytest.raises(LinkError, match="cannot be opened: Too many open files"):
                    open_port(name)
            assert len(os.listdir("/proc/self/fd")) == descriptors


class TestCallbacksThatEnd:
    def test_a_skin_does_not_keep_what_an_ended_callback_refers_to(self) -> None:
        """A program that adds and ends callbacks as long as it runs does not grow."""

        class Listener:
            def hear(self, frame: Frame) -> None:
                """Nothing is done with it."""

        with Skin(described(frame(0))) as skin:
            listener = Listener()
            kept = weakref.ref(listener)
            skin.on_frame(listener.hear).close()
            del listener
            skin.on_frame(lambda _: None)
            until(lambda: gc.collect() >= 0 and kept() is None)


class TestWhatIsSaid:
    def test_a_skin_shows_its_port_its_cells_and_whether_frames_come(self) -> None:
        skin = Skin(described(frame(0)))
        assert repr(skin) == "<Skin script: 3 x 2 cells, serial number A1; open>"
        skin.close()
        assert repr(skin) == "<Skin script: 3 x 2 cells, serial number A1; over>"

    def test_a_closed_skin_takes_no_orders(self) -> None:
        skin = Skin(described(frame(0)))
        skin.close()
        with pytest.raises(LinkEnded, match="script: the skin is closed"):
            skin.request(Order.STOP)

    def test_a_port_on_which_frames_have_come_is_not_called_silent(self) -> None:
        with Skin(described(frame(0))) as skin:
            skin.read(60.0)
            with pytest.raises(LinkTimeout, match=r"no frame within 0 s: nothing came since the last frame, .* s ago"):
                skin.read(0.0)


class TestNumbers:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"timeout": 0.0}, "timeout is 0.0 s; expected more than 0"),
            ({"timeout": float("nan")}, "timeout is nan; expected a number, in s"),
            ({"queue": 2.5}, "queue is 2.5; expected a whole number, at least 1"),
            ({"reconnect": -1.0}, "reconnect is -1.0 s; expected at least 0"),
            ({"pitch": -0.004}, "pitch is -0.004 m; expected more than 0"),
            ({"pitch": (0.004, 0.0)}, r"pitch is \(0.004, 0.0\) m; expected more than 0, or two such numbers"),
            ({"pitch": (0.004, 0.004, 0.004)}, "expected more than 0, or two such numbers"),
            ({"design": "no-such.toml"}, "no-such.toml: cannot be read"),
            ({"cell": "no-such.toml"}, "no-such.toml: cannot be read"),
        ],
    )
    def test_what_cannot_be_is_refused_and_the_port_closed(self, options: dict[str, Any], message: str) -> None:
        port = described()
        with pytest.raises(InputError, match=message):
            Skin(port, **options)
        assert port.closed

    def test_one_may_wait_for_ever(self) -> None:
        forever = float("inf")
        with lossless(described(frame(0), frame(1, flags=Flag.LAST)), timeout=forever, reconnect=forever) as skin:
            assert skin.read(forever).sequence == 0
            assert skin.latest(forever, forever).sequence == 1
            assert list(skin) == []

    @pytest.mark.parametrize("age", [0.0, -1.0, float("nan"), "x", None])
    def test_no_frame_can_be_so_young(self, age: Any) -> None:
        with Skin(described(frame(0))) as skin, pytest.raises(InputError, match=r"max_age is .*; expected"):
            skin.latest(max_age=age)

    def test_a_wait_is_a_number_of_seconds(self) -> None:
        with Skin(described(frame(0))) as skin:
            for wrong in (float("nan"), "3", []):
                with pytest.raises(InputError, match=r"timeout is .*; expected a number, in s"):
                    skin.read(wrong)  # type: ignore[arg-type]
                with pytest.raises(InputError, match=r"timeout is .*; expected a number, in s"):
                    skin.latest(0.1, timeout=wrong)  # type: ignore[arg-type]

    def test_a_wait_may_be_over_already(self) -> None:
        with lossless(described(frame(0)), timeout=60.0) as skin:
            skin.read()
            with pytest.raises(LinkTimeout, match="no frame within"):
                skin.read(-1)

    def test_numbers_may_be_numpys(self) -> None:
        options: dict[str, Any] = {"timeout": np.float32(60), "queue": np.int64(8), "accuracy": np.float32(0.5)}
        with lossless(described(frame(0), frame(1, flags=Flag.LAST)), **options) as skin:
            assert skin.read(np.float32(60)).sequence == 0
            assert skin.latest(np.int64(60), np.int64(60)).sequence == 1

    @pytest.mark.parametrize("frames", [0, -1, 2.5, float("nan"), "20", True, None])
    def test_a_tare_takes_a_whole_number_of_frames(self, frames: Any) -> None:
        with Skin(described(frame(0))) as skin, pytest.raises(InputError, match="expected a whole number"):
            skin.tare(frames)

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda skin: skin.on_frame(3), "callback is 3; expected a function"),
            (lambda skin: skin.on_frame(print, on_end="x"), "on_end is 'x'; expected a function"),
            (lambda skin: skin.on_bytes(None), "tap is None; expected a function"),
            (lambda skin: skin.request("start"), "order is 'start'; expected an ohmskin.wire.Order"),
            (lambda skin: skin.use_tare(3), "tare is 3; expected a Tare or the path of its file"),
            (lambda skin: skin.use_tare("no-such.npz"), "no-such.npz: cannot be read: No such file"),
            (lambda skin: skin.tare(drift="x"), "drift is 'x'; expected a number"),
            (lambda skin: Recorder(skin, 3), "name of the recording is 3; expected the path of a file"),  # type: ignore[arg-type]
            (lambda skin: Recorder("skin", "x.mcap"), "skin is 'skin'; expected an open Skin"),  # type: ignore[arg-type]
            (lambda skin: discover("/dev/ttyACM0"), "ports is '/dev/ttyACM0'; expected a list of names"),
            (lambda skin: discover([3]), "port is 3; expected the name of a port"),  # type: ignore[list-item]
            (lambda skin: Design.load(0), "path is 0; expected the path of a file"),  # type: ignore[arg-type]
            (lambda skin: Tare.load(0), "path is 0; expected the path of a file"),  # type: ignore[arg-type]
        ],
    )
    def test_an_argument_of_the_wrong_type_is_one_line(self, call: Callable[[Any], object], message: str) -> None:
        """And the skin goes on."""
        with lossless(described(frame(0), frame(1, flags=Flag.LAST))) as skin:
            with pytest.raises(InputError, match=re.escape(message)) as caught:
                call(skin)
            assert "\n" not in str(caught.value)
            assert [taken.sequence for taken in skin] == [0, 1]

    def test_design_and_cell_may_be_files(self) -> None:
        cell = EXAMPLES / "cell.toml"
        design = EXAMPLES / "prototype.toml"
        counts = encode(FramePacket.of(np.full((4, 4), 900), sequence=0, time_us=0, boot_id=1))
        cells = {"cell": cell} if cell.exists() else {}
        with Skin(Script(sheet(), counts), design=str(design), timeout=30.0, **cells) as skin:  # type: ignore[arg-type]
            assert skin.design.array.shape == next(skin).pressure.shape == (4, 4)


def test_a_port_says_when_one_read_has_brought_all() -> None:
    reading, writing = os.pipe()
    os.set_blocking(reading, False)

    class Pipe(DescriptorPort):
        def _release(self) -> None:
            os.close(reading)

    port = Pipe("pipe", reading)
    for size in (1, 156, 1024, 5000):
        os.write(writing, bytes(size))
        found, more = 0, True
        while more and found < size:
            arrival = port.read()
            found, more = found + len(arrival.data), arrival.more
        assert found == size
        assert more == (size >= 1024), "a short read is the last one; after a long one there may be more"
    assert port.read().data == b""
    port.close()
    os.close(writing)
