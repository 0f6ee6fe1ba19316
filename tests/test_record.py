"""Recording, replay and export: the same frames bit for bit, whatever ended the recording."""

from __future__ import annotations

import base64
import csv
import json
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from dataclasses import replace
from itertools import islice
from pathlib import Path

import hostile
import numpy as np
import pytest
from boards import EXAMPLES, Script, Wire, gone, identity, scene, sheet, until
from boards import frame as packet

from ohmskin.cli import run
from ohmskin.common.config import fingerprint
from ohmskin.driver import Calibration, Frame, Recorder, ReplayPort, Skin, to_xarray
from ohmskin.emulator import Board, PtyPort, running
from ohmskin.errors import InputError, LinkEnded, ProtocolError
from ohmskin.wire import Flag

ARRAYS = ("counts", "rest_counts", "valid", "resistance", "pressure", "pressure_std")
NUMBERS = (
    "sequence",
    "device_time",
    "host_time",
    "monotonic_time",
    "lost_before",
    "overrun",
    "reconnected",
    "rebooted",
    "estimator_restarted",
)


def same(one: Frame, other: Frame) -> bool:
    """Whether two frames agree in every bit."""
    arrays = all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in ARRAYS)
    return arrays and all(getattr(one, name) == getattr(other, name) for name in NUMBERS)


def pieces(numbers: range, *, boot_id: int = 1, last: bool = False) -> list[bytes]:
    """What a board says: who it is, its description, and frames of these numbers."""
    draw = np.random.default_rng(boot_id)
    ends = {numbers[-1]: Flag.LAST} if last else {}
    frames = [
        packet(k, boot_id=boot_id, level=2000 + draw.integers(-40, 40, (3, 2)), flags=ends.get(k, Flag.NONE))
        for k in numbers
    ]
    return [identity(boot_id), sheet(boot_id), *frames]


def recorded(path: Path, count: int = 200) -> list[Frame]:
    """Record an emulated board, and return its frames."""
    with Skin(Wire(Board(scene())), delivery="lossless", record=path) as skin:
        return list(islice(skin, count))


def replayed(path: Path) -> list[Frame]:
    with Skin.open(str(path)) as skin:
        return list(skin)


def test_a_replay_gives_the_same_frames_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "press.mcap"
    live = recorded(path)
    again = replayed(path)
    assert len(again) >= len(live)  # bytes that were read but not yet taken are recorded too
    assert all(same(one, other) for one, other in zip(live, again, strict=False))
    assert max(frame.pressure[1, 1] for frame in again) > 10


@pytest.mark.parametrize("burst", [1, 64])
def test_tares_among_frames_that_came_together_are_replayed_where_they_were(tmp_path: Path, burst: int) -> None:
    """Also by the recording of a replay. Frames that came together may have one time of arrival, as at a fast clock."""
    path, copied = tmp_path / "tare.mcap", tmp_path / "copy.mcap"
    said = pieces(range(90), last=True)
    together = [b"".join(said[k : k + burst]) for k in range(2, len(said), burst)]
    with Skin(Script(*said[:2], *together), delivery="lossless", record=path) as skin:
        live = list(islice(skin, 20))
        skin.tare(10, force=True)
        live += islice(skin, 15)
        skin.undo_tare()
        live += list(skin)
    with Skin.open(str(path), record=copied) as skin:
        assert len(list(skin)) == 90
    for one in (path, copied):
        again = {frame.sequence: frame for frame in replayed(one)}
        assert [frame.sequence for frame in again.values() if frame.estimator_restarted] == [0, 30, 45]
        assert [same(frame, again[frame.sequence]) for frame in live] == [True] * 80


def test_reconnection_losses_and_noise_are_replayed(tmp_path: Path) -> None:
    path = tmp_path / "life.mcap"
    first = Script(*pieces(range(5)), b"noise\0", *pieces(range(8, 12))[2:], last=gone)
    second = Script(*pieces(range(3, 9), boot_id=2, last=True))
    with Skin(first, delivery="lossless", reopen=lambda: second, record=path) as skin:
        live = list(skin)
        stats = skin.stats()
    assert (stats.reconnects, stats.reboots, stats.lost, stats.corrupt) == (1, 1, 6, 1)
    with Skin.open(str(path)) as skin:
        again = list(skin)
        after = skin.stats()
        assert skin.serial_number == "A1"
    assert len(live) == len(again) == 15
    assert all(map(same, live, again))
    assert (after.reconnects, after.reboots, after.lost, after.corrupt) == (1, 1, 6, 1)


def calibrated() -> Calibration:
    """Of the cells of the scene's board."""
    skin = scene().skin
    ones = np.ones((3, 2))
    rest = np.linspace(0.9, 1.1, 6).reshape(3, 2) * skin.cell.rest_resistance_ohm
    return Calibration(
        rest_ohm=rest,
        gain=np.linspace(0.7, 1.5, 6).reshape(3, 2),
        gain_std=0.02 * ones,
        rest_std_kpa=0.1 * ones,
        residual_kpa=0.1 * ones,
        calibrated=ones > 0,
        loads_kpa=(5.0, 12.0),
        presses=12,
        serial_number="EMULATED",
        date="2026-01-02T03:04:05+00:00",
        design_hash=fingerprint(skin.design),
        cell_hash=fingerprint(skin.cell),
    )


def test_what_was_given_at_opening_is_given_again(tmp_path: Path) -> None:
    pitch = (0.0031, 0.007)
    path = tmp_path / "given.mcap"
    what = scene().skin
    other = what.design.replace(array={"row_lead": 0.0})
    known = replace(calibrated(), design_hash=fingerprint(other), serial_number="A1")
    options = {"design": other, "cell": what.cell, "estimator": "static", "pitch": pitch, "calibration": known}
    with Skin(Script(*pieces(range(9), last=True)), delivery="lossless", record=path, **options) as skin:  # type: ignore[arg-type]
        live = list(skin)
    with Skin.open(str(path)) as skin:
        assert (skin.design, skin.cell, skin.calibration and skin.calibration.hash) == (other, what.cell, known.hash)
        again = list(skin)
        assert skin.pitch_xy_m == pitch
    assert all(map(same, live, again))


@pytest.mark.parametrize("cut", [0, 7])
def test_a_recorder_joins_an_open_skin_and_leaves_it(tmp_path: Path, cut: int) -> None:
    """The replay begins with the next whole frame, and knows the board and the rest resistances; ids begin anew."""
    path, copied = tmp_path / "join.mcap", tmp_path / "copy.mcap"
    said = pieces(range(90), last=True)
    port = Script(*said[:42], said[42][:cut])
    with Skin(port, delivery="lossless") as skin:
        tare = skin.tare(10, force=True)
        live = list(islice(skin, 30))
        with Recorder(skin, path) as recorder:
            port.say(said[42][cut:], *said[43:])
            live += islice(skin, 30)
            skin.undo_tare()
            live += islice(skin, 10)
        assert recorder.error is None
        recorder.close()  # a second time does nothing
        assert next(skin).lost_before == 0
    with Skin.open(str(path), record=copied) as skin:
        again = list(skin)
        assert skin.serial_number == "A1"
    assert (again[0].sequence, again[0].lost_before) == (41 if cut else 40, 0)
    by_number = {frame.sequence: frame for frame in live}
    seen = [frame for frame in again if frame.sequence in by_number]
    assert len(seen) >= 39
    for one in seen:
        other = by_number[one.sequence]
        np.testing.assert_array_equal(one.counts, other.counts)
        assert one.lost_before == 0
    ratio = np.array([frame.resistance for frame in again[:10]]).mean(axis=0) / tare.rest_resistance_ohm
    np.testing.assert_allclose(ratio, 1.0, atol=0.03)
    assert [frame.sequence for frame in again[1:] if frame.estimator_restarted] == [
        again[0].sequence + 30
    ]  # where the tare was undone
    assert all(map(same, again, replayed(copied)))


def test_a_joined_recording_settles_under_a_press(tmp_path: Path) -> None:
    path = tmp_path / "press.mcap"
    hold = {"cells": [[1, 1]], "load_kpa": [[0.0, 0.0], [1.0, 0.0], [1.05, 15.5], [9.0, 15.5]]}
    with Skin(Wire(Board(scene(contact=[hold]))), delivery="lossless", queue=4) as skin:
        skin.tare(20)
        list(islice(skin, 100))
        with Recorder(skin, path):
            live = {frame.sequence: frame for frame in islice(skin, 300)}
    again = [frame for frame in replayed(path) if frame.sequence in live]
    apart = np.array([frame.pressure - live[frame.sequence].pressure for frame in again])
    std = np.array([frame.pressure_std for frame in again])
    pressed = np.zeros((3, 2), dtype=np.bool_)
    pressed[1, 1] = True
    assert (np.abs(apart) < 2 * std + 0.1)[:, ~pressed].all()
    assert (np.abs(apart) < 2 * std + 0.1)[:40].all()  # it says that it does not know how long the press has lasted
    assert np.abs(apart[40:]).max() < 0.15 * 15.5
    assert np.abs(apart[-1]).max() < 0.1 * 15.5


def test_a_recorder_joins_while_the_board_is_away(tmp_path: Path) -> None:
    path = tmp_path / "away.mcap"
    back = threading.Event()

    def reopen() -> Script:
        if not back.wait(60):
            raise AssertionError
        return Script(*pieces(range(7, 12), last=True))

    with Skin(Script(*pieces(range(5)), last=gone), delivery="lossless", reopen=reopen) as skin:
        list(islice(skin, 5))
        until(lambda: skin.away is not None)
        with Recorder(skin, path):
            back.set()
            live = list(skin)
    assert [(frame.reconnected, frame.lost_before) for frame in live[:2]] == [(True, 2), (False, 0)]
    again = replayed(path)
    assert [(frame.sequence, frame.reconnected) for frame in again] == [(k, k == 7) for k in range(7, 12)]


def test_a_recorder_ends_with_its_skin_and_refuses_a_closed_one(tmp_path: Path) -> None:
    path = tmp_path / "ended.mcap"
    with Skin(Script(*pieces(range(9))), delivery="lossless") as skin:
        recorder = Recorder(skin, path)
        for _ in range(9):
            next(skin)
    recorder.close()
    with Skin.open(str(path)) as again:
        assert again.serial_number == "A1"
    with pytest.raises(LinkEnded, match="the skin is closed"):
        Recorder(skin, tmp_path / "late.mcap")
    with Skin(Script(*pieces(range(2))), delivery="lossless") as skin:
        with pytest.raises(InputError, match="cannot be written"):
            Recorder(skin, tmp_path / "nowhere" / "x.mcap")
        with pytest.raises(InputError, match="No space left on device"), Recorder(skin, "/dev/full"):
            assert next(skin).sequence == 0
        assert next(skin).sequence == 1


def test_a_recorder_that_is_killed_leaves_all_but_its_last_second(tmp_path: Path) -> None:
    """Cut off anywhere, the file can be read up to there."""
    path = tmp_path / "killed.mcap"
    port = PtyPort()
    with running(scene(board={"frame_rate": 200.0}), port):
        process = subprocess.Popen([sys.executable, "-m", "ohmskin", "record", port.name, "-o", str(path)])
        try:
            until(lambda: path.exists() and path.stat().st_size > 60_000)
        finally:
            process.kill()
            process.wait()
    whole, frames = path.read_bytes(), replayed(path)
    assert len(frames) > 10
    path.write_bytes(whole[: round(0.8 * len(whole))])
    part = replayed(path)
    assert 0 < len(part) < len(frames)
    assert all(map(same, part, frames))


def test_viewers_find_images_and_numbers(tmp_path: Path) -> None:
    """Read with mcap itself, as Foxglove would."""
    from mcap.reader import make_reader

    path = tmp_path / "seen.mcap"
    with Skin(Script(*pieces(range(3))), delivery="every", record=path) as skin:
        live = [next(skin) for _ in range(3)]
    with path.open("rb") as file:
        found = list(make_reader(file).iter_messages(topics=["/ohmskin/pressure", "/ohmskin/frame"]))
    images = [json.loads(message.data) for schema, _, message in found if schema and schema.name == "foxglove.RawImage"]
    numbers = [json.loads(message.data) for schema, _, message in found if schema and schema.name == "ohmskin.Frame"]
    assert len(images) == len(numbers) == 3
    for frame, image, values in zip(live, images, numbers, strict=True):
        data = base64.b64decode(image["data"])
        assert (image["encoding"], image["step"]) == ("32FC1", 4 * image["width"])
        pressure = np.frombuffer(data, dtype="<f4").reshape(image["height"], image["width"])
        np.testing.assert_array_equal(pressure, frame.pressure.astype("<f4"))
        assert values["sequence"] == frame.sequence
        assert values["host_time"] == frame.host_time


def test_a_full_disk_ends_the_recording_and_not_the_skin() -> None:
    with pytest.raises(InputError, match=r"/dev/full: cannot be written: No space left on device"):  # noqa: SIM117
        with Skin(Script(*pieces(range(5))), delivery="lossless", record="/dev/full") as skin:
            assert [next(skin).sequence for _ in range(5)] == list(range(5))


@pytest.mark.parametrize("room", [0, 100])
def test_a_disk_that_is_full_already_leaves_no_file_and_replaces_none(room: int, tmp_path: Path) -> None:
    """No room for the head of a recording, or for a part of it."""
    old, new, limits = tmp_path / "old.mcap", tmp_path / "new.mcap", resource.getrlimit(resource.RLIMIT_FSIZE)
    recorded(old, 2)
    before = old.read_bytes()
    for path in (old, new):
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
            with pytest.raises(InputError, match=rf"{path.name}: cannot be written: File too large"):
                Skin(Script(*pieces(range(5))), delivery="lossless", record=path, overwrite=True)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert old.read_bytes() == before
    assert list(tmp_path.iterdir()) == [old]


def test_a_replay_at_a_speed_takes_its_time(tmp_path: Path) -> None:
    path = tmp_path / "paced.mcap"
    port = Script(*pieces(range(1)))
    with Skin(port, delivery="lossless", record=path) as skin:
        next(skin)
        port.later_s = 0.6
        port.say(*pieces(range(600, 601))[2:])
        next(skin)
    began = time.monotonic()
    with Skin.open(str(path), speed=2.0) as skin:
        frames = [next(skin), next(skin)]
        assert 0 <= frames[-1].age < 60  # on the recording's clock
    assert time.monotonic() - began > 0.25
    with pytest.raises(InputError, match=r"speed 0\.0; expected a positive number"):
        Skin.open(path, speed=0.0)
    with pytest.raises(InputError, match=r"speed is 2\.0, but only a recording"):
        Skin.open("/dev/ttyNone", speed=2.0)


@pytest.mark.parametrize("content", [b"", b"time,pressure\n1,2\n", b"\x89MCAP0\r\n"])
def test_what_is_no_recording_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "no.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"no\.mcap: is no ") as caught:
        Skin.open(str(path))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        Skin.open(str(tmp_path / "nowhere.mcap"))


HOSTILE = {
    "deep_chunks": (50, "more bytes, decompressed,"),
    "many_tares": (30_000, "more records"),
    "many_arrivals": (30_000, "more records"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_small_file_that_asks_for_much_is_refused(kind: str, tmp_path: Path) -> None:
    path, opened = tmp_path / "hostile.mcap", []
    count, said = HOSTILE[kind]
    getattr(hostile, kind)(path, count)
    assert path.stat().st_size < 2**19
    with pytest.raises(InputError, match=rf"hostile\.mcap: {said} than a recording of \d+ (KiB|bytes) has"):
        Skin.open(str(path), progress=lambda done, total, _: opened.append(done / total))
    assert all(0 < share <= 1 for share in opened)


def test_what_a_chunk_says_of_its_size_is_not_believed(tmp_path: Path) -> None:
    """zstd and LZ4 know their own size, by which a library would decompress."""
    for compression in ("zstd", "lz4"):
        path = tmp_path / f"{compression}.mcap"
        hostile.deep_chunks(path, 1, said=1000, compression=compression)
        tracemalloc.start()
        with pytest.raises(LinkEnded):  # damaged, so the recording ends there
            Skin.open(str(path), timeout=0.1)
        assert tracemalloc.get_traced_memory()[1] < hostile.DEEP / 4
        tracemalloc.stop()


def test_a_record_is_made_of_its_own_bytes(tmp_path: Path) -> None:
    """Whatever its head says of its length; mcap's reader would go on behind it."""
    path = tmp_path / "lies.mcap"
    hostile.write(path, [])
    sound = path.read_bytes()
    place = sound.index(b"ohmskin", sound.index(b"\x0c", 8)) - 13  # the metadata
    assert sound[place] == 12
    (length,) = struct.unpack_from("<Q", sound, place + 1)
    ReplayPort(path)
    for other in (1, length - 20, length - 1, 2**63):
        path.write_bytes(sound[: place + 1] + struct.pack("<Q", other) + sound[place + 9 :])
        with pytest.raises(InputError, match=r"lies\.mcap: is no recording of ohmskin"):
            ReplayPort(path)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (
            ("/ohmskin/events", b'{"event": "x", "y": [' + b"[]," * 10**5 + b"[]]}"),
            "an event of more than 100000 values",
        ),
        (("/ohmskin/bytes", bytes(17 * 2**20)), "an arrival of 17 MiB"),
    ],
)
def test_one_message_that_asks_for_much_is_refused(message: tuple[str, bytes], said: str, tmp_path: Path) -> None:
    path = tmp_path / "hostile.mcap"
    hostile.write(path, [message])
    with pytest.raises(InputError, match=said):
        Skin.open(str(path))


def test_many_tares_between_two_frames_cost_one(tmp_path: Path) -> None:
    """Only the last one counts, and each would set the estimator up anew."""
    from mcap.reader import make_reader

    path, tared = tmp_path / "tared.mcap", []
    hostile.many_tares(path, 5_000, frames=(0, 1))
    with Skin.open(str(path), record=tmp_path / "copy.mcap") as skin:
        assert len(list(skin)) == 2
    with (tmp_path / "copy.mcap").open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=["/ohmskin/events"]):
            tared.append(json.loads(message.data)["event"])
    assert tared.count("rest") == 1


def test_the_commands_record_replay_and_export(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    port = PtyPort()
    with running(scene(), port, clock="fast", duration_s=4.0):
        assert run(["record", port.name, "-o", str(first)]) == 0
    _, message = capfd.readouterr()
    assert ": 200 frames, 0 lost, 0 reconnects" in message

    link = tmp_path / "skin"
    player = subprocess.Popen(
        [sys.executable, "-m", "ohmskin", "replay", str(first), "--link", str(link), "--speed", "100"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert player.stdout is not None
        assert player.stdout.readline().strip() == str(link)
        assert run(["record", str(link), "-o", str(second)]) == 0
        assert player.wait(30) == 0
    finally:
        player.kill()
        player.communicate()

    for name in ("first", "second"):
        assert run(["export", str(tmp_path / f"{name}.mcap"), "-o", str(tmp_path / f"{name}.npz")]) == 0
    with np.load(tmp_path / "first.npz") as one, np.load(tmp_path / "second.npz") as other:
        fields = {name for name in one.files if not name.startswith("contact_")}
        assert fields == {*ARRAYS, *NUMBERS, "time", "place_mm", "area_mm2"} - {"monotonic_time", "estimator_restarted"}
        assert len(one["contact_force_n"]) == len(one["contact_frame"]) > 0
        np.testing.assert_array_equal(one["sequence"], np.arange(200))
        for field in ("sequence", "device_time", "counts", "pressure"):
            np.testing.assert_array_equal(one[field], other[field])
        pressure = one["pressure"]

    assert run(["export", str(first), "-o", str(tmp_path / "first.csv")]) == 0
    with (tmp_path / "first.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["pressure_kpa_1_1"]) for row in rows] == pressure[:, 1, 1].tolist()
    assert [int(row["sequence"]) for row in rows] == list(range(200))
    assert all(float(row["pressure_std_kpa_1_1"]) > 0 and row["valid_1_1"] == "1" for row in rows)
    assert len({row["counts_1_1"] for row in rows}) > 1
    parquet = pytest.importorskip("pyarrow.parquet")
    assert run(["export", str(first), "-o", str(tmp_path / "first.parquet")]) == 0
    assert parquet.read_table(tmp_path / "first.parquet")["pressure_kpa_1_1"].to_pylist() == pressure[:, 1, 1].tolist()


def test_what_a_board_does_not_send_is_empty_and_no_number(tmp_path: Path) -> None:
    file = tmp_path / "mat.mcap"
    address = "ohmskin://demo?clock=fast&duration=0.8&board=m1616"
    with Skin.open(address, board="m1616", delivery="lossless", record=file) as skin:
        assert len(list(skin)) > 10
    for kind in ("csv", "npz", "parquet"):
        assert run(["export", str(file), "-o", str(tmp_path / f"mat.{kind}")]) == 0
    with (tmp_path / "mat.csv").open() as table:
        assert {(row["sequence"], row["lost_before"], row["device_time"]) for row in csv.DictReader(table)} == {
            ("", "", "")
        }
    with np.load(tmp_path / "mat.npz") as arrays:
        assert len(arrays["sequence"]) > 10
        assert np.isnan(arrays["sequence"]).all()
    parquet = pytest.importorskip("pyarrow.parquet")
    assert set(parquet.read_table(tmp_path / "mat.parquet")["sequence"].to_pylist()) == {None}


def test_frames_become_a_dataset_with_units(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    path, exported = tmp_path / "press.mcap", tmp_path / "press.nc"
    live = recorded(path, 60)
    with Skin.open(str(path)) as skin:
        data = to_xarray(skin, skin)
        assert data.attrs["serial_number"] == skin.serial_number
        assert data.attrs["design_sha256"] == fingerprint(skin.design)
        pitch_mm = 1e3 * skin.pitch_m
    assert dict(data.sizes) == {"time": len(data.time), "row": 3, "column": 2}
    np.testing.assert_array_equal(data.x_mm, [0.0, pitch_mm])
    np.testing.assert_array_equal(data.y_mm, [0.0, pitch_mm, 2 * pitch_mm])
    for k, frame in enumerate(live):
        np.testing.assert_array_equal(data.pressure[k], frame.pressure)
        np.testing.assert_array_equal(data.counts[k], frame.counts)
        assert data.time[k].astype(np.int64) == round(1e9 * frame.host_time)
    assert (data.pressure.units, data.resistance.units, data.device_time.units) == ("kPa", "ohm", "s")
    assert run(["export", str(path), "-o", str(exported)]) == 0
    with xarray.open_dataset(exported) as read:
        xarray.testing.assert_equal(read.drop_vars("time"), data.drop_vars("time"))
        assert np.abs((read.time - data.time).astype(np.int64)).max() <= 1000  # as CF's encoding of dates rounds
        assert read.pressure.attrs["units"] == "kPa"
        assert read.valid.dtype == bool
    with pytest.raises(InputError, match="no frames"):
        to_xarray([])
    with Skin.open(str(path)) as skin:
        assert dict(to_xarray([], skin).sizes) == {"time": 0, "row": 3, "column": 2}


def test_the_command_records_with_a_calibration_and_a_tare(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The recording holds both, so that its replay needs neither file."""
    made = calibrated()
    calibration, tare, path = tmp_path / "left.toml", tmp_path / "rest.npz", tmp_path / "press.mcap"
    made.save(calibration)
    words = ["-o", str(path), "--calibration", str(calibration), "--tare", str(tare), "--json"]
    with Skin(Wire(Board(scene(contact=[]))), delivery="lossless", calibration=calibration) as opened:
        opened.tare(5, force=True).save(tare)
    port = PtyPort()
    with running(scene(contact=[]), port, clock="fast", duration_s=2.0):
        assert run(["record", port.name, *words]) == 0
    said = json.loads(capfd.readouterr().out)
    assert said["file"] == str(path)
    assert said["frames"] > 0
    with Skin.open(str(path)) as again:
        frames = list(again)
        assert len(frames) == said["frames"]
        assert again.calibration is not None
        assert again.calibration.hash == made.hash
    # Unloaded; by the calibration's rest resistances, which hold until the tare is in use, some cells are pressed.
    tared = max(k for k, frame in enumerate(frames) if frame.estimator_restarted)
    pressure = np.array([frame.pressure for frame in frames[tared:]])
    assert len(pressure) > 10
    assert np.abs(pressure).max() < 0.1

    assert run(["record", port.name, *words]) == 2  # gone by now; nothing that was recorded is touched
    with Skin.open(str(path)) as again:
        assert len(list(again)) == said["frames"]


def test_a_recording_is_scored_as_its_export_is(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    truth, path, arrays = tmp_path / "truth.npz", tmp_path / "press.mcap", tmp_path / "press.npz"
    port = PtyPort()
    with running(scene(), port, clock="fast", duration_s=3.0, truth=truth):
        assert run(["record", port.name, "-o", str(path)]) == 0
    assert run(["export", str(path), "-o", str(arrays)]) == 0
    capfd.readouterr()
    shown = []
    for recording in (path, arrays):
        assert run(["score", str(recording), str(truth), "--json"]) == 0
        shown.append(json.loads(capfd.readouterr().out))
    assert shown[0] == shown[1]
    assert (shown[0]["frames"], shown[0]["lost_frames"]) == (150, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["record", "/dev/nothing-here", "-o", "{tmp}/x.mcap"], "/dev/nothing-here: no such port"),
        (["record", "/dev/nothing-here", "-o", "{tmp}/x.csv"], "x.csv: is no name of a recording; expected FILE.mcap"),
        (["export", "{tmp}/nowhere.mcap", "-o", "{tmp}/x.npz"], "nowhere.mcap: cannot be read: No such file"),
        (
            ["export", "{tmp}/nowhere.mcap", "-o", "{tmp}/x.txt"],
            "expected a name that ends in .npz, .csv, .parquet, .nc",
        ),
        (["export", "{tmp}/nowhere.csv", "-o", "{tmp}/x.npz"], "nowhere.csv: is no name of a recording"),
        (["replay", "{tmp}/nowhere.mcap"], "nowhere.mcap: cannot be read: No such file"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    arguments: list[str], message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run([argument.format(tmp=tmp_path) for argument in arguments]) == 2
    _, errors = capfd.readouterr()
    assert message in errors
    assert errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_scene_is_recorded_like_a_port(tmp_path: Path) -> None:
    scene, output = EXAMPLES / "fingers.toml", tmp_path / "fingers.mcap"
    assert run(["record", str(scene), "-o", str(output), "--duration", "0.5"]) == 0
    with Skin.open(output) as skin:
        assert next(skin).pressure.shape == (4, 4)


def test_a_recording_is_not_replaced_unless_asked(tmp_path: Path) -> None:
    file = tmp_path / "hours of work.mcap"
    file.write_bytes(b"precious")
    port = Script(*pieces(range(5), last=True))
    with pytest.raises(InputError, match=r"is there already; choose another name, or .*overwrite=True"):
        Skin(port, record=file)
    assert port.closed
    assert file.read_bytes() == b"precious"
    with Skin(Script(*pieces(range(5), last=True)), delivery="lossless", record=file, overwrite=True) as skin:
        assert len(list(skin)) == 5
    assert len(list(Skin.open(str(file)))) == 5


@pytest.mark.skipif(sys.platform == "win32", reason="files are marked by flock")
def test_the_second_recorder_of_a_file_is_refused_whichever_came_first(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    with Skin(Wire(Board(scene())), delivery="lossless", record=path) as skin:
        with pytest.raises(InputError, match=r"one\.mcap: is being recorded at present"):
            Recorder(skin, path, overwrite=True)
        with pytest.raises(InputError, match=r"one\.mcap: is being recorded at present"):
            Skin(Wire(Board(scene())), record=path, overwrite=True)
        taken = list(islice(skin, 30))
    assert all(map(same, taken, replayed(path)))
    assert [file.name for file in tmp_path.iterdir()] == ["one.mcap"]
    with Skin(Wire(Board(scene())), delivery="lossless") as skin, Recorder(skin, path, overwrite=True):
        next(skin)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_that_ends_leaves_the_recording_to_its_parent(tmp_path: Path) -> None:
    path = tmp_path / "parent.mcap"
    program = f"""
import os, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from boards import Wire, scene
from ohmskin.driver import Skin
from ohmskin.emulator import Board
with Skin(Wire(Board(scene())), delivery="lossless", record={str(path)!r}) as skin:
    skin.read()
    if os.fork() == 0:
        sys.exit(0)
    os.wait()
    for _ in range(99):
        skin.read()
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=300)
    with Skin.open(path) as skin:
        assert len(list(islice(skin, 100))) == 100


@pytest.mark.parametrize("before", [None, b"precious"])
def test_a_board_that_is_silent_at_the_handshake_leaves_no_recording_and_replaces_none(
    before: bytes | None, tmp_path: Path
) -> None:
    """Else the next attempt, with the plug where it belongs, is refused since there is a file."""
    file = tmp_path / "press.mcap"
    if before is not None:
        file.write_bytes(before)
    with pytest.raises(ProtocolError, match="no description within"):
        Skin(Script(b"no packet"), timeout=0.1, record=file, overwrite=True)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == ([] if before is None else [before])


def test_a_recording_that_is_interrupted_says_what_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a duration, that is how it ends."""
    file, port = tmp_path / "press.mcap", PtyPort()
    with running(scene(), port), monkeypatch.context() as patch:
        patch.setattr(Skin, "read", lambda skin, _: next(skin) and signal.raise_signal(signal.SIGINT))
        assert run(["record", port.name, "-o", str(file)]) == 130
    said, interrupted = capsys.readouterr().err.splitlines()
    assert re.search(r"press\.mcap: [1-9]\d* frames, 0 lost, 0 reconnects", said)
    assert interrupted == "ohmskin: interrupted"
