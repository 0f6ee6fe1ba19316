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
import random
import re
import signal
import socket
import threading
import time
import weakref
from collections.abc import AsyncIterator, Callable
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from boards import EXAMPLES, Flow, Script, Wire, described, frame, gone, identity, lossless, scene, sheet, until

from ohmskin.circuits import Design
from ohmskin.driver import Frame, LinkStatistics, Recorder, Skin, discover, open_port
from ohmskin.driver._port_names import why_not_opened
from ohmskin.emulator import Board, PtyPort, Rfc2217Port, TcpPort, running
from ohmskin.errors import InputError, LinkEnded, LinkError, LinkTimeout, OhmskinError, ProtocolError
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


async def _first(skin: Skin, count: int) -> AsyncIterator[Frame]:
    async for one in skin:
        yield one
        count -= 1
        if not count:
            return


def played(numbers: list[int], times_us: list[int]) -> tuple[list[Frame], LinkStatistics]:
    """Frames with these numbers and times of the board, each 10 ms of the host's time after the one before."""
    head = identity(sequence=numbers[0]) + sheet(sequence=numbers[0])
    said = [frame(number % 2**32, us=us) for number, us in zip(numbers, times_us, strict=True)] + [b"\0"]
    port = Flow(head, said.__getitem__, 0.01, at_once=4096)
    frames = []
    with Skin(port, delivery="every", timeout=60.0) as skin:
        for _ in numbers:
            port.work(0.01 + 1e-12)
            frames.append(skin.read())
        return frames, skin.stats()


def take_all(skin: Skin, how: str) -> int:
    """Frames to the end, taken in one of the ways there are; raises what the reader raises."""

    async def follow() -> int:
        return len([one async for one in skin])

    match how:
        case "iteration":
            return len(list(skin))
        case "async":
            return asyncio.run(follow())
    taken: list[Frame] = []
    ends: list[Exception] = []
    skin.on_frame(taken.append, ends.append)
    until(lambda: bool(ends))
    assert isinstance(ends[0], LinkEnded)
    return len(taken)


class TestOwners:
    """Who has a port, within one program."""

    def test_a_port_can_be_opened_again_as_soon_as_a_reader_learns_of_the_closing(self) -> None:
        port = PtyPort()
        with running(scene(), port):
            for _ in range(3):
                skin = Skin.open(port.name, timeout=30.0)
                closing = threading.Thread(target=skin.close)
                closing.start()
                list(skin)
                Skin.open(port.name, timeout=30.0).close()
                closing.join()

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
            recording, held = skin.recorder, weakref.ref(skin)
            assert recording is not None
            del skin
            gc.collect()
            assert held() is None
            until(lambda: recording.frames > 300)
        recording.close()
        until(lambda: not any(port.name in thread.name for thread in threading.enumerate()))  # the reader ends, too
        with Skin.open(str(path)) as replay:
            assert len(list(replay)) > 300

    @pytest.mark.parametrize("how", ["callback", "async", "frames"])
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
                frames = Skin.open(port.name, timeout=30.0).frames()
                gc.collect()
                assert len(list(islice(frames, 200))) == 200
                del frames
            gc.collect()
            until(lambda: opens(port.name))  # the reader thread closes it


def opens(name: str) -> bool:
    """Whether the port is nobody's."""
    try:
        Skin.open(name, timeout=30.0).close()
    except LinkError:
        return False
    return True


class TestFiniteBoards:
    """An emulation that is over says so, whatever the line does to its last frame."""

    @pytest.mark.parametrize("how", ["iteration", "async", "callback"])
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

    def test_a_board_that_ended_before_it_described_itself_says_so(self) -> None:
        with pytest.raises(LinkEnded, match="come to the end of its frames, and has not described itself before"):
            Skin(Script(identity(), frame(0), identity(over=True)), timeout=30.0)

    def test_a_board_in_this_process_is_not_started_again(self) -> None:
        """Its family has no packet for an end."""
        url = f"ohmskin://{EXAMPLES / 'fingers.toml'}?clock=fast&duration=1&board=fsr-array"
        design = EXAMPLES.parent / "verification" / "prototype.toml"
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

    @pytest.mark.parametrize("seconds", [-1800, 2.0, 3600])
    def test_a_clock_that_is_set_is_no_hour_under_load(self, seconds: float) -> None:
        """The estimator goes on, and no frame looks older or younger than it is."""
        start_us = 4_000_000_000
        times_us = [start_us + 10_000 * k + (round(1e6 * seconds) if k >= 100 else 0) for k in range(200)]
        frames, stats = played([*range(400_000, 400_200)], times_us)
        times = np.array([one.monotonic_time for one in frames])
        np.testing.assert_allclose(np.diff(times), 0.01, atol=1e-6)
        assert not any(one.estimator_restarted for one in frames[1:])
        assert (stats.reboots, stats.late, stats.lost, stats.clock_steps) == (0, 0, 0, 1)

    def test_time_that_flies_is_no_clock_that_was_set(self) -> None:
        """The emulator's fast clock, with packets that are lost."""
        numbers = [k for k in range(200) if k % 7 and not 100 < k < 150]
        _, stats = played(numbers, [1_000_000 * k for k in numbers])
        assert (stats.clock_steps, stats.reboots, stats.lost) == (0, 0, 200 - 1 - len(numbers))

    @pytest.mark.parametrize("ahead", [10**9, 50_000, -50_000, 2**31 + 7])
    def test_a_number_that_no_time_explains_is_no_loss(self, ahead: int) -> None:
        """One intact packet of a stream of 100 frames a second with another number; then the board counts on."""
        numbers = [100_000 + k + (ahead if k == 60 else 0) for k in range(100)]
        frames, stats = played(numbers, [10_000 * (10**5 + k) for k in range(100)])
        assert all(one.lost_before == 0 for one in frames[1:])
        assert (stats.frames, stats.resyncs, stats.reboots) == (100, 2, 0)


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

    def test_nothing_is_dropped_for_a_reader_that_begins_later_while_there_is_room(self) -> None:
        port = described(*(frame(k) for k in range(8)))
        seen: list[Frame] = []
        with Skin(port, delivery="lossless", queue=10) as skin:
            skin.on_frame(seen.append)
            until(lambda: len(seen) == 8)
            assert [next(skin).sequence for _ in range(8)] == list(range(8))

    def test_a_reader_that_stopped_is_named_to_the_one_that_waits_for_it(self) -> None:
        port = described(*(frame(k) for k in range(30)))
        with Skin(port, delivery="lossless", queue=10, timeout=1.0) as skin:
            next(skin)  # from now on frames are kept for this place
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
        until(lambda: all(callback.is_over for callback in callbacks))
        skin.close()

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

    def test_a_task_that_is_cancelled_ends(self) -> None:
        """As by asyncio.timeout()."""

        async def cancel() -> bool:
            task = asyncio.ensure_future(anext(aiter(skin)))  # type: ignore[arg-type]
            await asyncio.sleep(0.05)
            task.cancel()
            await asyncio.wait([task], timeout=30.0)
            return task.cancelled()

        with Skin(described(frame(0)), timeout=60.0) as skin:
            next(skin)
            assert asyncio.run(cancel())

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
            assert sorted(taken) == [2, 5, 5, 5]

    @pytest.mark.parametrize("kind", ["pty", "tcp", "rfc2217", "ohmskin"])
    def test_opening_again_and_again_leaves_no_thread_and_no_descriptor(self, kind: str) -> None:
        """Also where the body of the ``with`` raises, and where the family does not fit."""
        port = {"tcp": TcpPort, "rfc2217": Rfc2217Port}[kind].at(":0") if kind in ("tcp", "rfc2217") else PtyPort()
        name = f"ohmskin://{EXAMPLES / 'fingers.toml'}" if kind == "ohmskin" else port.name
        with running(scene(board={"frame_rate": 400.0}), port):
            for k in range(4):
                if k == 1:
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
    @pytest.mark.parametrize(
        ("data", "looks"),
        [
            (b"12,13,14\r\n15,16,17\r\n18,1", "text such as '15,16,17'"),
            (bytes(range(130, 170)), "binary such as 82 83 84 85"),
        ],
    )
    def test_what_is_no_packet_is_shown_with_the_command_that_goes_on(self, data: bytes, looks: str) -> None:
        port = Script(data)
        with pytest.raises(ProtocolError) as caught:
            Skin(port, timeout=0.3)
        assert looks in str(caught.value)
        assert f"`ohmskin doctor {port.name}`" in str(caught.value)

    @pytest.mark.parametrize(
        ("mode", "mine", "said"),
        [
            (0o660, False, "belongs to group '{}', which this user is not in; `ohmskin doctor {}` says"),
            (0o640, False, "belongs to group '{}', and its mode -rw-r----- keeps this user out; `ohmskin doctor {}`"),
            (0o660, True, "belongs to group '{}', and its mode -rw-rw---- keeps this user out; `ohmskin doctor {}`"),
        ],
    )
    def test_a_forbidden_port_is_told_with_its_group_or_its_mode(
        self, mode: int, mine: bool, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        port = tmp_path / "ttyUSB0"
        port.touch(mode)
        port.chmod(mode)
        group = port.stat().st_gid
        monkeypatch.setattr(os, "getegid", lambda: group if mine else group + 1)
        monkeypatch.setattr(os, "getgroups", list)
        told = why_not_opened(str(port), PermissionError(errno.EACCES, "Permission denied"))
        assert said.format(port.group(), port) in told

    def test_too_many_open_files_are_one_message_and_leave_nothing_open(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail() -> None:
            raise OSError(errno.EMFILE, "Too many open files")

        terminal = PtyPort()
        with terminal, socket.create_server(("127.0.0.1", 0)) as server:
            descriptors = len(os.listdir("/proc/self/fd"))
            monkeypatch.setattr(socket, "socketpair", fail)
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

    def test_a_port_on_which_frames_have_come_is_not_called_silent(self) -> None:
        with Skin(described(frame(0))) as skin:
            skin.read(60.0)
            with pytest.raises(LinkTimeout, match=r"no frame within 0 s: nothing came since the last frame, .* s ago"):
                skin.read(0.0)


SECONDS = "; expected a number, in s"


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
            ({"design": "no-such.toml"}, "no-such.toml: cannot be read"),
        ],
    )
    def test_what_cannot_be_is_refused_and_the_port_closed(self, options: dict[str, Any], message: str) -> None:
        port = described()
        with pytest.raises(InputError, match=message):
            Skin(port, **options)
        assert port.closed

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            *(
                (lambda skin, age=age: skin.latest(max_age=age), "max_age is ")
                for age in (0.0, float("nan"), "x", None)
            ),
            *((lambda skin, wait=wait: skin.read(wait), SECONDS) for wait in (float("nan"), "3", [])),
            *((lambda skin, wait=wait: skin.latest(0.1, timeout=wait), SECONDS) for wait in (float("nan"), "3", [])),
            *((lambda skin, count=count: skin.tare(count), "a whole number") for count in (0, 2.5, "20", True)),
            (lambda skin: skin.on_frame(3), "callback is 3; expected a function"),
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
        ],
    )
    def test_an_argument_of_the_wrong_type_is_one_line(self, call: Callable[[Any], object], message: str) -> None:
        """And the skin goes on."""
        with lossless(described(frame(0), frame(1, flags=Flag.LAST))) as skin:
            with pytest.raises(InputError, match=re.escape(message)) as caught:
                call(skin)
            assert "\n" not in str(caught.value)
            assert [taken.sequence for taken in skin] == [0, 1]


# A reader that is interrupted again and again gets every frame that it is told of, and never waits for ever


INTERRUPTS = 300


@pytest.mark.slow
def test_interrupts_lose_no_count_and_no_lock() -> None:
    armed = False
    hits = contradictions = 0

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal armed
        if armed:
            armed = False
            raise KeyboardInterrupt

    def pester(ended: threading.Event) -> None:
        rng, main = random.Random(1), threading.main_thread().ident
        assert main is not None
        while not ended.is_set():
            time.sleep(rng.uniform(0.0, 0.01))
            signal.pthread_kill(main, signal.SIGUSR1)

    before_handler = signal.signal(signal.SIGUSR1, interrupt)
    ended = threading.Event()
    pesterer = threading.Thread(target=pester, args=(ended,))
    port = PtyPort()
    try:
        with running(scene(board={"frame_rate": 200.0}), port), Skin.open(port.name, delivery="every") as skin:
            before = skin.read()
            pesterer.start()
            while hits < INTERRUPTS:
                try:
                    armed = True
                    while True:
                        frame = skin.read(30.0)
                        missing = frame.sequence - before.sequence - 1
                        contradictions += missing != frame.lost_before + frame.skipped_before
                        before = frame
                except KeyboardInterrupt:
                    hits += 1
            ended.set()
            pesterer.join()
            assert skin.read(30.0).sequence > before.sequence
    finally:
        ended.set()
        pesterer.join()
        signal.signal(signal.SIGUSR1, before_handler)
    assert not contradictions
