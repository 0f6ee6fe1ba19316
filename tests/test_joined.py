"""Several boards that are one skin."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, PRESS, Flow, scene
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.circuits import Reason, Shape
from ohmskin.cli import run
from ohmskin.common.arrays import FloatArray
from ohmskin.common.geometry import Geometry
from ohmskin.driver import ContactTracker, Frame, JoinedSkin, Skin
from ohmskin.driver._consumer import Consumer
from ohmskin.driver._contacts import Touch
from ohmskin.driver._joined import JoinedBoards, JoinedFrames, Joiner, joined_geometry
from ohmskin.driver._tuning import ABSENT_S
from ohmskin.emulator import Board, PtyPort, Scene, load_scenes, running
from ohmskin.errors import InputError, LinkEnded, LinkError, ProtocolError
from ohmskin.wire import Order, host_protocol

HAND = Path(__file__).parents[1] / "examples/hand/hand.toml"


def part(first_column: int, **more: Any) -> Scene:
    """A 3 x 2 board of cells of 10 mm, whose columns begin at a place of its own."""
    places = [(row, column) for row in range(3) for column in range(2)]
    shape = {
        "row": [row for row, _ in places],
        "column": [column for _, column in places],
        "x_mm": [10.0 * (first_column + column) for _, column in places],
        "y_mm": [10.0 * row for row, _ in places],
        "area_mm2": [100.0] * 6,
    }
    press = {"bump": {"center_mm": [10.0, 15.0], "sigma_mm": 6.0}, "load_kpa": [[0.0, 0.0], [0.4, 0.0], [0.5, 12.0]]}
    return scene(skin={"design": DESIGN | {"shape": shape}}, contact=[press], **more)


def played(tmp_path: Path, *scenes: Scene) -> list[Path]:
    """Recordings of the boards over the same second, on a clock of their own: no load of this machine is in them."""
    files = [tmp_path / f"skin-{k}.mcap" for k in range(1, len(scenes) + 1)]
    for one, file in zip(scenes, files, strict=True):
        board, period_s = Board(one, seed=1), 1.0 / one.board.frame_rate
        for order in (Order.IDENTIFY, Order.DESCRIBE, Order.START):
            board.receive(host_protocol("ohmskin").request(order))
        handshake = b"".join(board.answers())
        packets = [b"".join(board.tick()) for _ in range(round(1.0 / period_s) + 1)]
        port = Flow(handshake, packets.__getitem__, period_s, at_once=4096)
        with Skin(port, delivery="every", record=file) as skin:
            for _ in packets[1:]:
                port.work(period_s + 1e-9)
                skin.read()
    return files


def _changes(pressures: list[FloatArray]) -> list[bytes]:
    """Those that differ from the one before."""
    shown = [pressure.tobytes() for pressure in pressures]
    return [one for one, before in zip(shown, [b"", *shown], strict=False) if one != before]


def test_a_press_across_two_boards_is_one_contact(tmp_path: Path) -> None:
    files = played(tmp_path, part(0), part(2, board={"frame_rate": 40.0, "serial_number": "RIGHT"}))
    with Skin.open(files) as skin:
        assert isinstance(skin, JoinedSkin)
        assert skin.shape == (6, 2)
        assert skin.serial_number == "EMULATED + RIGHT"
        assert [board.shape for board in skin.boards] == [(3, 2), (3, 2)]
        frames = [frame for frame in skin if frame.contacts is not None]  # asked for from the first frame on
        alone = [list(Skin.open(file)) for file in files]
    whole = [frame for frame in frames if frame.valid.all()]  # while both boards live
    assert len(whole) > 20
    (contact,) = whole[-1].contacts
    assert {row // 3 for row, _ in contact.cells.tolist()} == {0, 1}
    assert contact.x_mm == pytest.approx(15.0, abs=0.5)
    assert contact.y_mm == pytest.approx(10.0, abs=0.5)
    for k, own in enumerate(alone):  # nothing of a board is lost or changed by joining
        part_of = [frame.pressure[3 * k : 3 * k + 3] for frame in frames]
        assert _changes([one for one in part_of if not np.isnan(one).any()]) == _changes([one.pressure for one in own])
    with Skin.open(files) as skin:
        assert [frame.contacts for frame in skin] == [frame.contacts for frame in frames]


def frame_at(time_s: float, geometry: Geometry, kpa: float = 0.0) -> Frame:
    grid = np.full(geometry.shape, kpa)
    return Frame(
        None, None, time_s, time_s, 0, 0, False, False, False, False, False,
        grid.astype(np.uint16), grid == kpa,
        np.zeros(geometry.shape, dtype=np.int8), grid + 1e3, grid, grid + 0.1, 0 * grid, geometry,
        lambda: (), lambda: time_s,
    )  # fmt: skip


@given(st.lists(st.tuples(st.sampled_from([0, 1, 2]), st.floats(0.001, 0.4)), max_size=40))
def test_every_frame_of_a_board_is_in_one_joined_frame_and_none_waits_for_a_silent_board(
    arrivals: list[tuple[int, float]],
) -> None:
    board = Geometry.rectangle((2, 2), 0.01)
    joiner = Joiner([board] * 3, Touch(20.0))
    now, came_s = 0.0, {0.0: 0.0}
    given_kpa, seen = [[0.0], [0.0], [0.0]], [[0.0], [0.0], [0.0]]
    for number, (which, pause_s) in enumerate(arrivals, start=1):
        now += pause_s
        given_kpa[which].append(float(number))
        came_s[float(number)] = now
        for frame in joiner.add(which, frame_at(now, board, float(number))):
            assert now - frame.monotonic_time <= 0.4 + 1e-9
            joined = frame.converted
            assert joined is not None
            for k in range(3):
                own = slice(2 * k, 2 * k + 2)
                if joined.valid[own].all():
                    kpa = float(joined.pressure[own][0, 0])
                    assert frame.monotonic_time - came_s[kpa] <= ABSENT_S
                    seen[k] += [] if kpa == seen[k][-1] else [kpa]
                else:
                    assert (joined.reason[own] == Reason.MISSING).all()
    for k in range(3):
        assert seen[k] in (given_kpa[k], given_kpa[k][:-1])


@given(st.lists(st.tuples(st.sampled_from([0, 1, 2]), st.floats(0.001, 0.4), st.floats(0.0, 0.3)), max_size=40))
def test_the_time_of_a_joined_skin_never_goes_back(arrivals: list[tuple[int, float, float]]) -> None:
    """Frames of the boards come with delays of their own; each board's come in order."""
    board = Geometry.rectangle((2, 2), 0.01)
    joiner, now, last = Joiner([board] * 3, Touch(20.0)), 0.0, [0.0, 0.0, 0.0]
    times = []
    for which, pause_s, delay_s in arrivals:
        now += pause_s
        last[which] = max(last[which], now - delay_s)
        for joined in joiner.add(which, frame_at(last[which], board)):
            times.append(joined.monotonic_time)
    assert times == sorted(times)


EVENTS = ("overrun", "reconnected", "rebooted", "estimator_restarted")


@given(st.sets(st.tuples(st.integers(0, 2), st.sampled_from(EVENTS))))
def test_what_happened_to_one_board_happened_to_the_joined_skin(happened: set[tuple[int, str]]) -> None:
    board = Geometry.rectangle((1, 1), 0.01)
    joiner, plain = Joiner([board] * 3, Touch(20.0)), frame_at(0.0, board)
    frames = JoinedFrames(joiner, [], "every", 10)
    reader = Consumer(JoinedBoards([], frames, joiner), after=0)
    for k in (0, 1, 2, 0):  # from then on a joined frame has one of each
        frames.arrive(k, plain)
    assert reader.next_frames(10, 0.0)
    for k in range(3):
        told: dict[str, Any] = {name: (k, name) in happened for name in EVENTS}
        frames.arrive(k, replace(plain, lost_before=k, **told))
    (joined,) = reader.next_frames(10, 0.0)
    assert {name for name in EVENTS if getattr(joined, name)} == {name for _, name in happened}
    assert joined.lost_before == 3


class Played:
    """A recording as a board: frames, and faults among them."""

    port_name, away = "played", None

    def __init__(self, *items: Frame | ProtocolError) -> None:
        self._items = iter(items)

    def __next__(self) -> Frame:
        item = next(self._items)
        if isinstance(item, ProtocolError):
            raise item
        return item


def test_a_fault_in_one_recording_ends_neither_it_nor_the_others() -> None:
    board = Geometry.rectangle((1, 1), 0.01)
    times = [0.01 * k for k in range(1, 9)]
    left, right = ([frame_at(s, board, s) for s in times] for _ in range(2))
    boards = [Played(*left[:3], ProtocolError("a fault"), *left[3:]), Played(*right)]
    joiner = Joiner([board] * 2, Touch(20.0))
    frames = JoinedFrames(joiner, boards, "lossless", 10)
    frames.play()
    reader, seen, faults = Consumer(JoinedBoards(boards, frames, joiner), after=0), [], 0
    while True:
        try:
            seen += reader.next_frames(3, 0.0)
        except ProtocolError:
            faults += 1
        except LinkEnded:
            break
    assert faults == 1
    for row in (0, 1):  # each frame of each recording is in one of them
        shown = [float(one.pressure[row, 0]) for one in seen]
        assert list(dict.fromkeys(kpa for kpa in shown if kpa > 0.0)) == times


def test_boards_without_places_stand_apart_and_boards_at_one_place_are_refused() -> None:
    board = Geometry.rectangle((2, 3), 0.01)
    joined = joined_geometry([board, Geometry.rectangle((4, 2), 0.01)])
    assert joined.shape == (6, 3)
    assert joined.exists.sum() == 14
    upper = set(range(6))
    assert not np.isin(joined.neighbours.near[:6], list(set(range(18)) - upper)).any()
    placed = Geometry(board.places_mm, board.areas_mm2)
    with pytest.raises(InputError, match="cells of two boards are at"):
        joined_geometry([placed, placed])
    with pytest.raises(InputError, match="expected all alike"):
        joined_geometry([placed, board])


async def _of(skin: Skin) -> AsyncIterator[Frame]:
    async for frame in skin:
        yield frame


def test_what_a_joined_skin_inherits_asks_no_single_board(tmp_path: Path) -> None:
    """Neither does it refuse more than what belongs to one board."""
    refused = {"design", "touch", "pitch_m", "pitch_xy_m", "identity", "description", "recorder"}
    with Skin.open(played(tmp_path, part(0), part(2, board={"serial_number": "RIGHT"}))) as skin:
        for name, _ in inspect.getmembers(Skin, lambda one: isinstance(one, property)):
            if name[0] != "_" and name not in refused:
                getattr(skin, name)
        first = skin.read()
        assert skin.latest(np.inf).monotonic_time >= first.monotonic_time
        assert 0 < len(skin.read_many(5)) <= 5
        assert next(iter(skin.frames())).monotonic_time > first.monotonic_time
        assert asyncio.run(anext(aiter(_of(skin)))).monotonic_time > first.monotonic_time
        skin.use_tare(None)
        for call in (lambda: skin.on_bytes(print), lambda: skin.request(Order.STOP), lambda: skin.use_tare("x")):
            with pytest.raises(InputError, match="ask one of the 2"):
                call()


def test_a_board_that_goes_takes_its_cells_along_only() -> None:
    left, right = PtyPort(), PtyPort()
    with (
        running(part(0), left),
        running(part(2), right, duration_s=1.0),
        Skin.open([left.name, right.name], reconnect=0.0, timeout=30.0) as skin,
    ):
        tare = skin.tare(5, force=True)
        assert tare.rest_resistance_ohm.shape == (6, 2)
        assert skin.tared is not None
        assert any(frame.valid.all() for frame, _ in zip(skin, range(20), strict=False))
        without = 0
        while without < 20:
            frame = skin.read()
            assert frame.valid[:3].all() or frame.valid[3:].all()
            without = 0 if frame.valid[3:].any() else without + 1
        assert (frame.reason[3:] == Reason.MISSING).all()
        assert skin.frames_since(frame.monotonic_time - 0.2)
        assert skin.latest(5.0).sequence is None
        seen: list[Frame] = []
        calls = skin.on_frame(seen.append)
        for _, _ in zip(skin.frames(), range(5), strict=False):
            pass
        calls.close()
        assert seen
        skin.close()
        with pytest.raises(LinkEnded):
            skin.read()


@pytest.mark.parametrize(
    ("ports", "options", "message"),
    [
        ([], {}, "no ports"),
        (["a.mcap", "/dev/ttyACM0"], {}, "recordings and ports"),
        (["/dev/a", "/dev/b"], {"delivery": "lossless"}, "delivery is lossless"),
        (["/dev/a", "/dev/b"], {"design": [None]}, "design has 1 values; expected one for each of 2 boards"),
    ],
)
def test_what_cannot_be_joined_is_refused(ports: list[str], options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Skin.open(ports, **options)


def test_a_board_that_is_not_there_closes_the_others() -> None:
    port = PtyPort()
    with running(scene(), port):
        with pytest.raises(LinkError, match="no such port"):
            Skin.open([port.name, "/dev/no-such-port"])
        Skin.open(port.name).close()


def test_a_scene_of_several_boards_shares_its_contacts(tmp_path: Path) -> None:
    fingers, palm = load_scenes(HAND)
    assert [len(one.contact) for one in (fingers, palm)] == [2, 1]
    (tmp_path / "a.toml").write_text('[skin]\ndesign = "d.toml"\n')
    beside = PRESS | {"cells": [[9, 9]]}
    tables = f'boards = ["{HAND.parent}/palm.toml"]\n[[contact]]\ncells = {beside["cells"]}\nload_kpa = [[0.0, 1.0]]\n'
    (tmp_path / "hand.toml").write_text(tables)
    with pytest.raises(InputError, match=r"contact\[0\]: on no board"):
        load_scenes(tmp_path / "hand.toml")


def test_the_commands_take_several_boards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["record", str(HAND), "-o", str(tmp_path / "hand.mcap"), "--duration", "0.5"]) == 0
    files = [str(tmp_path / f"hand-{k}.mcap") for k in (1, 2)]
    for kind in ("npz", "csv"):
        assert run(["export", *files, "-o", str(tmp_path / f"hand.{kind}")]) == 0
    with np.load(tmp_path / "hand.npz") as arrays:
        assert arrays["pressure"].shape[1:] == (12, 8)
        assert np.isfinite(arrays["place_mm"]).all(axis=-1).sum() == 83
        assert (np.isfinite(arrays["place_mm"]).all(axis=-1) == (arrays["area_mm2"] > 0)).all()
    head = (tmp_path / "hand.csv").read_text().partition("\n")[0].split(",")
    assert sum(name.startswith("pressure_kpa_") for name in head) == 83
    assert len(Shape.load(tmp_path / "hand.shape.csv").row) == 83
    capsys.readouterr()
    assert run(["emulate", str(HAND), "--plan"]) == 0
    assert capsys.readouterr().out.count("cells, ") == 2
    assert run(["emulate", str(HAND), "--tcp", ":0"]) == 2


@given(st.integers(0, 2**32), st.booleans())
def test_contacts_of_boards_apart_are_those_of_each_alone(seed: int, faults_press: bool) -> None:
    """Lines of one board are none of another, though their columns stand below each other."""
    rng = np.random.default_rng(seed)
    boards = [Geometry.rectangle((4, 5), 0.01), Geometry.rectangle((6, 5), 0.01), Geometry.rectangle((3, 2), 0.01)]
    together = ContactTracker(joined_geometry(boards), 20.0, 0.5, faults_press)
    alone = [ContactTracker(board, 20.0, 0.5, faults_press) for board in boards]
    kinds = rng.integers(0, 4, len(boards))
    for k in range(4):
        whole, std = np.full((13, 5), np.nan), np.full((13, 5), np.nan)
        expected, first = [], 0
        for board, tracker, kind in zip(boards, alone, kinds.tolist(), strict=True):
            rows, columns = board.shape
            kpa, noise = rng.normal(0.0, 0.1, board.shape), np.full(board.shape, rng.choice([0.1, 0.5, 1.5]))
            if k > 0 and kind == 1:
                kpa[:, rng.integers(columns)] += 5.0  # a converter
            elif k > 0 and kind == 2:
                kpa[rng.integers(rows), : rng.integers(1, columns)] += 5.0  # a crack
            elif k > 0 and kind == 3:
                kpa[1:3, :2] += rng.uniform(0.5, 6.0)  # a finger
            whole[first : first + rows, :columns], std[first : first + rows, :columns] = kpa, noise
            for contact in tracker.update(0.01 * k, kpa, noise):
                cells = contact.cells + np.array([first, 0])
                expected.append((cells.tolist(), contact.force_n, contact.area_mm2))
            first += rows
        found = [(one.cells.tolist(), one.force_n, one.area_mm2) for one in together.update(0.01 * k, whole, std)]
        for one, other in zip(sorted(found), sorted(expected), strict=True):
            assert one[0] == other[0]
            assert one[1:] == pytest.approx(other[1:])
