"""The page of `ohmskin view`, in headless Chromium: what it shows equals the frames."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, RemoteDisconnected
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from boards import DESIGN, Script, Wire, frame, gone, identity, scene, sheet
from boards import until as wait_until
from pages import colours_of_cells, opened, paused, served, shown, start, until
from patience import HANG_S, Patience
from playwright.sync_api import Browser, expect, sync_playwright
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from ohmskin.circuits import Reason
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import Frame, Skin
from ohmskin.emulator import Board, Hand, PtyPort, Scene, running
from ohmskin.errors import InputError, MissingExtra
from ohmskin.view import LiveSource, RecordedSource
from ohmskin.wire import BoardFile, Flag

WIDE = {**DESIGN, "array": {"rows": 6, "columns": 8, "row_lead": 70.0}}
SHORTED = {"at_s": 0.0, "kind": "shorted-cell", "place": [0, 7]}
SAMPLES = "(({series}) => Array.from({length: series.length}, (_, k) => series.at(k)))(ohmskin.chosen[0])"
ARRAYS = {"pressure": "pressure", "std": "pressure_std", "resistance": "resistance"}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = start(playwright)
        yield browser
        browser.close()


class Live:
    """An emulated board with a hand on it, its page, and every frame that the driver took."""

    def __init__(self, url: str, skin: Skin, hand: Hand) -> None:
        self.url, self.skin, self.hand = url, skin, hand
        self.frames: dict[float, Frame] = {}
        skin.on_frame(lambda frame: self.frames.update({frame.host_time: frame}))

    def frame_of(self, values: dict[str, Any]) -> Frame:
        """The driver's frame with the time that a frame of the page has."""
        patience = Patience()
        while values["hostTime_s"] not in self.frames:  # the page may have it before this test is
            patience.spend()
            time.sleep(0.01)
        return self.frames[values["hostTime_s"]]


@contextmanager
def live(design: dict[str, Any] = WIDE, **tables: Any) -> Iterator[Live]:
    described = scene(**{"skin": {"design": design, "pitch_mm": 5.0}, "contact": [], **tables})
    hand, port = Hand(described.skin.design.array.shape), PtyPort()
    with running(described, port, hand=hand):
        skin = Skin.open(port.name, delivery="every", queue=4096)
        with served(LiveSource(skin)) as url:
            yield Live(url, skin, hand)


def bump(shape: tuple[int, int] = (6, 8)) -> FloatArray:
    """A finger, in kPa, that presses hardest on cell (2, 3)."""
    row, column = np.indices(shape)
    return 12.0 * np.exp(-((row - 2.0) ** 2 + (column - 3.0) ** 2))


def as_shown(values: Any) -> list[float | None]:
    """Numbers of a frame as the page gets them: float32, and null for NaN."""
    return [None if math.isnan(value) else float(value) for value in np.asarray(values, dtype=np.float32).ravel()]


def test_values_pixels_and_contacts_equal_the_frame(browser: Browser) -> None:
    with live(event=[SHORTED]) as board, opened(browser, board.url) as page:
        since = board.hand.press(bump())
        until(page, "since => ohmskin.frame.deviceTime_s > since + 1", since)
        values = paused(page)
        frame = board.frame_of(values)
        for name, of_frame in ARRAYS.items():
            assert values[name] == as_shown(getattr(frame, of_frame)), name
        assert values["counts"] == frame.counts.ravel().tolist()
        assert values["valid"] == frame.valid.ravel().astype(int).tolist()
        assert values["deviceTime_s"] == frame.device_time
        assert not frame.valid[0, 7]
        assert frame.valid.sum() > 30
        assert 8.0 < frame.pressure[2, 3] < 16.0

        scale = page.evaluate("async () => (await import('./colours.js')).COLOURS")
        full_scale = page.evaluate("ohmskin.scale[1]")
        cells, marks = colours_of_cells(page, "cells"), colours_of_cells(page, "marks")
        for index, (kpa, valid) in enumerate(zip(values["pressure"], values["valid"], strict=True)):
            colours = {colour[:3] for colour in cells[index]}
            if valid:
                share = min(max(kpa / full_scale, 0.0), 1.0)
                assert colours == {tuple(scale[min(int(256 * share), 255)])}
            else:
                assert len(colours) > 1
                assert all(max(colour) - min(colour) < 20 for colour in colours), "a grey hatching"

        expect(page.locator("#contacts tbody tr")).to_have_count(len(frame.contacts))
        assert len(frame.contacts) == 1
        (contact,) = frame.contacts
        (drawn,) = values["contacts"]
        assert drawn["id"] == contact.id
        for name in ("x_mm", "y_mm", "force_n", "peak_kpa", "area_mm2"):
            assert drawn[name] == float(np.float32(getattr(contact, name)))
        texts = [f"{contact.id}", f"{contact.force_n:.2f}", f"{contact.peak_kpa:.1f}"]
        texts += [f"{contact.x_mm:.1f}, {contact.y_mm:.1f}", f"{contact.area_mm2:.0f}"]
        assert page.locator("#contacts tbody td").all_inner_texts() == texts
        centre = round(contact.y_mm / 5.0) * 8 + round(contact.x_mm / 5.0)
        assert any(colour[3] for colour in marks[centre]), "the cross at its centre"
        assert not any(colour[3] for colour in marks[47]), "nothing far away"


@pytest.mark.parametrize("space", [False, True])
def test_cells_are_drawn_where_they_are(browser: Browser, space: bool) -> None:
    """At any turn, with the colour of their pressure; the pointer finds them there."""
    row, column = (index.ravel() for index in np.indices((6, 8)))
    there = (row + column) % 7 != 3
    places = {"x_mm": 9.0 * column + row, "y_mm": 11.0 * row}
    if space:
        places = {"x_mm": 30 * np.sin(column / 4), "y_mm": 11.0 * row, "z_mm": 30 * np.cos(column / 4)}
    shape = {name: values[there].tolist() for name, values in ({"row": row, "column": column} | places).items()}
    with live(skin={"design": WIDE | {"shape": shape}}) as board, opened(browser, board.url) as page:
        since = board.hand.press(bump())
        until(page, "since => ohmskin.frame.deviceTime_s > since + 1", since)
        page.click("#rotate")
        values = paused(page)
        frame = board.frame_of(values)
        expect(page.locator("#source")).to_contain_text(f"{there.sum()} cells")
        if space:
            box = page.locator("#map").bounding_box()
            assert box is not None
            before = page.evaluate("ohmskin.map.angles")
            page.mouse.move(box["x"] + 200, box["y"] + 200)
            page.mouse.down()
            page.mouse.move(box["x"] + 260, box["y"] + 220, steps=3)
            page.mouse.up()
            until(page, "before => ohmskin.map.angles[0] !== before", before[0])
            paused(page)
            assert page.evaluate("ohmskin.chosen.length") == 0, "a turn chooses no cell"
        drawn = page.evaluate(
            """() => {
                const {map} = ohmskin;
                const context = map.cells.getContext("2d");
                context.lineWidth = 6;
                const hidden = (k) => map.order.slice(map.order.indexOf(k) + 1)
                    .some((other) => context.isPointInPath(map.paths[other], ...map.middles[k])
                        || context.isPointInStroke(map.paths[other], ...map.middles[k]));
                return map.middles.map(([x, y], k) => ({index: map.shape.index[k], at: [x / map.ratio, y / map.ratio],
                    colour: [...context.getImageData(x, y, 1, 1).data], hidden: hidden(k), shade: map.shades[k]}));
            }"""
        )
        assert [one["index"] for one in drawn] == np.flatnonzero(there).tolist()
        scale = page.evaluate("async () => (await import('./colours.js')).COLOURS")
        full_scale = page.evaluate("ohmskin.scale[1]")
        seen = [one for one in drawn if not one["hidden"]]
        assert len(seen) > (10 if space else 40)
        for one in seen:
            assert frame.valid.flat[one["index"]]
            share = min(max(values["pressure"][one["index"]] / full_scale, 0.0), 1.0)
            expected = np.array(scale[min(int(256 * share), 255)]) * (1.0 - one["shade"])
            np.testing.assert_allclose(one["colour"][:3], expected, atol=2.0)
        one = seen[7]
        page.hover("#map", position=dict(zip("xy", one["at"], strict=True)))
        expect(page.locator("#cell-place")).to_have_text("{}, {}".format(*divmod(one["index"], 8)))
        assert "no cell" not in page.locator("#link").inner_text()
        (contact,) = frame.contacts
        np.testing.assert_equal(
            values["contacts"][0]["z_mm"], np.float32(np.nan if contact.z_mm is None else contact.z_mm)
        )


def test_the_cell_under_the_pointer_is_shown_in_full(browser: Browser) -> None:
    with live(event=[SHORTED]) as board, opened(browser, board.url) as page:
        board.hand.press(bump())
        frame = board.frame_of(paused(page))
        page.focus("#map")
        page.keyboard.press("ArrowDown")
        page.keyboard.press("ArrowUp")
        for index in range(48):
            place = divmod(index, 8)
            until(page, f"document.getElementById('cell-place').textContent === '{place[0]}, {place[1]}'")
            text = dict(
                page.evaluate("[...document.querySelectorAll('#cell dd')].map((one) => [one.id, one.innerText])")
            )
            valid = bool(frame.valid[place])
            pressure = float(np.float32(frame.pressure[place]))
            kpa = "–" if math.isnan(pressure) else f"{pressure:.3f}"
            assert text["cell-pressure"] == f"{kpa} kPa{'' if valid else ' (kept)'}"
            assert text["cell-counts"] == str(frame.counts[place])
            why = Reason(int(frame.reason[place])).name.lower().replace("_", " ")
            assert text["cell-valid"] == ("valid" if valid else f"not valid: {why}")
            if valid:
                assert text["cell-std"] == f"± {np.float32(frame.pressure_std[place]):.3f} kPa"
                number, unit = text["cell-resistance"].split()
                assert float(number) * {"kΩ": 1e3, "Ω": 1.0}[unit] == pytest.approx(frame.resistance[place], rel=1e-3)
            page.keyboard.press("ArrowRight")
            if place[1] == 7:
                page.keyboard.press("ArrowDown")
        x, y = page.evaluate("ohmskin.map.corner(2 * 8 + 3).map((at) => (at + 4) / ohmskin.map.ratio)")
        page.hover("#map", position={"x": x, "y": y})
        expect(page.locator("#cell-place")).to_have_text("2, 3")


def test_a_turned_and_mirrored_map_shows_each_cell_where_the_pointer_finds_it(browser: Browser) -> None:
    """Quarter turns are rotations: four of them are none, and each maps every cell to a square of its own."""
    with live() as board, opened(browser, board.url) as page:
        board.hand.press(bump())
        until(page, "ohmskin.frame.contacts.length === 1")
        paused(page)
        squares = "Array.from({length: 48}, (_, k) => ohmskin.map.squareOf(k))"
        for mirrored in (False, True):
            for turns in range(4):
                rows, columns = np.indices((6, 8))
                grid = np.rot90((rows * 8 + columns)[:, ::-1] if mirrored else rows * 8 + columns, -turns)
                assert [grid[y, x] for x, y in page.evaluate(squares)] == list(range(48))
                x, y = page.evaluate("ohmskin.map.corner(2 * 8 + 3).map((at) => (at + 4) / ohmskin.map.ratio)")
                page.hover("#map", position={"x": x, "y": y})
                expect(page.locator("#cell-place")).to_have_text("2, 3")
                assert any(colour[3] for colour in colours_of_cells(page, "marks")[2 * 8 + 3]), "the contact's cross"
                page.click("#rotate")
            page.click("#mirror")
        assert page.evaluate("ohmskin.map.labels(0)") == [str(column) for column in range(8)]
        page.select_option("#axes", "mm")
        assert [float(label) for label in page.evaluate("ohmskin.map.labels(0)")] == [5.0 * k for k in range(8)]


def test_total_force_threshold_and_what_can_be_saved(browser: Browser) -> None:
    with live(event=[SHORTED]) as board, opened(browser, board.url, accept_downloads=True) as page:
        since = board.hand.press(bump())
        until(page, "since => ohmskin.frame.deviceTime_s > since + 1", since)
        values = paused(page)
        frame = board.frame_of(values)
        force = float(frame.pressure[frame.valid].sum()) * 25.0e-3
        assert values["totalForce_n"] == pytest.approx(force, rel=1e-6)
        expect(page.locator("#total")).to_have_text(f"{force:.2f} N")
        page.select_option("#plotted", "force")
        page.fill("#threshold", "0.5")
        assert page.evaluate("[ohmskin.plotView().unit, ohmskin.plotView().threshold]") == ["N", 0.5]
        assert page.evaluate("ohmskin.total.at(ohmskin.total.length - 1)[1]") == pytest.approx(force, rel=0.05)
        with page.expect_download() as download:
            page.click("#numbers")
        lines = download.value.path().read_text().splitlines()
        assert lines[0] == "row,column,pressure_kpa,std_kpa,resistance_ohm,counts,valid"
        table = [line.split(",") for line in lines[1:]]
        assert [int(line[5]) for line in table] == frame.counts.ravel().tolist()
        assert [line[6] == "1" for line in table] == frame.valid.ravel().tolist()
        with page.expect_download() as download:
            page.click("#picture")
        assert download.value.path().read_bytes().startswith(b"\x89PNG")


def test_a_recording_is_begun_and_ended_by_a_button(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with live() as board, opened(browser, board.url) as page:
        page.click("#record")
        expect(page.locator("#record")).to_have_text("Stop recording")
        expect(page.locator("#recorded")).to_contain_text("to skin-")
        since = page.evaluate("ohmskin.frame.number")
        until(page, "since => ohmskin.frame.number > since + 10", since)
        page.click("#record")
        expect(page.locator("#record")).to_have_text("Record")
    (file,) = tmp_path.glob("skin-*.mcap")
    with Skin.open(file) as replayed:
        assert sum(1 for _ in replayed) >= 10


def test_the_scale_follows_the_load_and_an_alarm_shows(browser: Browser) -> None:
    """Without a load it ends at a fiftieth of the full scale, so that noise stays dark; it is never beyond it."""
    with live() as board, opened(browser, board.url) as page:
        until(page, "ohmskin.scale[1] < 1.0 && ohmskin.scale[0] === 0")
        assert page.locator("body.alarm").count() == 0
        page.fill("#threshold", "2")
        board.hand.press(bump())
        until(page, "document.body.classList.contains('alarm')")
        until(page, "ohmskin.scale[1] >= Math.max(...ohmskin.frame.pressure)")
        assert page.evaluate("ohmskin.scale[1] <= ohmskin.skin.full_scale_kpa")
        page.select_option("#range", "full")
        until(page, "ohmskin.scale[1] === ohmskin.skin.full_scale_kpa")
        board.hand.press(0.0)
        until(page, "!document.body.classList.contains('alarm')")


def test_the_map_is_made_larger_and_smaller(browser: Browser) -> None:
    with live() as board, opened(browser, board.url) as page:
        until(page, "ohmskin.map.side > 0")
        side = page.evaluate("ohmskin.map.side")
        page.click("#zoom-in")
        assert page.evaluate("ohmskin.map.side") > side
        assert page.evaluate("document.documentElement.scrollWidth") <= page.evaluate("innerWidth")
        page.click("#zoom-out")
        page.click("#zoom-out")
        assert page.evaluate("ohmskin.map.side") < side


def test_the_page_says_which_estimator_it_is_and_why_cells_are_not_valid(browser: Browser) -> None:
    with live(event=[SHORTED]) as board, opened(browser, board.url) as page:
        expect(page.locator("#link")).to_contain_text(board.skin.estimator_name)
        assert board.skin.estimator_name
        expect(page.locator("#link")).to_contain_text("1 saturated")


def test_tare_undo_and_a_refusal(browser: Browser) -> None:
    with live() as board, opened(browser, board.url) as page:
        expect(page.locator("#tare-state")).to_contain_text("data sheet")
        page.click("#tare")
        expect(page.locator("#tare-answer")).to_have_text("tared over 20 frames")
        assert board.skin.tared is not None
        page.click("#undo")
        expect(page.locator("#tare-state")).to_contain_text("data sheet")
        assert board.skin.tared is None
        expect(page.locator("#undo")).to_be_hidden()
        board.hand.press(bump())
        page.click("#tare")
        expect(page.locator("#tare-answer")).to_contain_text("seems to be loaded")
        assert board.skin.tared is None
        page.click("#tare-anyway")
        expect(page.locator("#tare-answer")).to_contain_text("tared over 20 frames, although")
        assert board.skin.tared is not None


def test_a_board_without_a_circuit_shows_counts(browser: Browser) -> None:
    """A missing number is hatched, and a tare leaves what is above it."""
    family = BoardFile.parse(
        {"board": {"name": "mat", "rows": 2, "columns": 3}, "frame": {"format": "text", "separator": ","}}, "mat"
    ).family()
    port, ended, line = Script(b"cut\n"), threading.Event(), [b"10,20,30,40,,60\n"]

    def play() -> None:
        while not ended.wait(0.01):
            port.say(*line)

    board = threading.Thread(target=play)
    board.start()
    try:
        with served(LiveSource(Skin(port, board=family, timeout=30.0))) as url, opened(browser, url) as page:
            expect(page.locator("#source")).to_contain_text("2 × 3")
            assert page.locator("#quantity option").all_inner_texts() == ["counts above rest", "counts"]
            page.locator("#tare").click()
            expect(page.locator("#tare-answer")).to_contain_text("5 of 6 cells measured")
            line[:] = [b"15,20,30,40,,60\n"]
            until(page, "ohmskin.frame && ohmskin.frame.change[0] === 5")
            assert page.evaluate("[...ohmskin.frame.valid]") == [1, 1, 1, 1, 0, 1]
            assert page.evaluate("[...ohmskin.frame.change].slice(1, 4)") == [0, 0, 0]
            expect(page.locator("#contacts-title")).not_to_be_visible()
    finally:
        ended.set()
        board.join()


def board_says(numbers: range, *, boot_id: int = 1, last: bool = False) -> list[bytes]:
    """The packets of a 3 x 2 board: who it is, then some frames."""
    flags = {numbers[-1]: Flag.LAST} if last else {}
    frames = [frame(k, boot_id=boot_id, level=2000 + k, us=10_000 * k, flags=flags.get(k, Flag.NONE)) for k in numbers]
    return [identity(boot_id), sheet(boot_id), *frames]


def test_a_board_that_goes_away_comes_back_and_ends(browser: Browser) -> None:
    back: list[Script] = []
    first = Script(*board_says(range(3)))

    def reopen() -> Script:
        return back[0] if back else gone()  # type: ignore[return-value]  # gone() only raises

    skin = Skin(first, reopen=reopen, reconnect=math.inf)
    with served(LiveSource(skin)) as url, opened(browser, url) as page:
        expect(page.locator("#state")).to_have_text("silent")
        first.say(*board_says(range(3, 5))[2:])
        until(page, "ohmskin.frame.counts[0] === 2004")
        first._last = gone
        expect(page.locator("#state")).to_have_text("away, reconnecting")
        expect(page.locator("#notice")).to_contain_text("gone")
        back.append(Script(*board_says(range(5, 9), last=True)))
        until(page, "ohmskin.frame.counts[0] === 2008")
        expect(page.locator("#state")).to_have_text("ended")
        expect(page.locator("#notice")).to_contain_text("end of its frames")
        pairs = page.locator("#link").inner_text().split("\n")
        assert pairs[pairs.index("reconnects") + 1] == "1"
        assert pairs[pairs.index("lost") + 1] == "0"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "press.mcap"
    with Skin(
        Wire(Board(scene(event=[{**SHORTED, "place": [0, 1], "at_s": 1.5}]))), delivery="lossless", record=path
    ) as skin:
        list(islice(skin, 150))
    return path


def test_the_slider_shows_the_frame_asked_for(browser: Browser, recording: Path) -> None:
    with Skin.open(str(recording)) as skin:
        frames = [frame for frame in skin if frame.contacts is not None]  # contacts are followed once asked for
    device_times = np.array([frame.device_time for frame in frames], dtype=np.float64)
    times = device_times - device_times[0]
    assert len(frames) >= 150
    assert not frames[-1].valid.all()
    with served(RecordedSource(Skin.open(str(recording)))) as url, opened(browser, url) as page:
        expect(page.locator("#state")).to_have_text("recording")
        expect(page.locator("#rest")).to_be_hidden()

        def judge(number: int) -> None:
            until(page, "number => ohmskin.frame.number === number", number)
            values, frame = shown(page), frames[number]
            assert values["time_s"] == pytest.approx(times[number], abs=1e-9)
            for name, of_frame in ARRAYS.items():
                assert values[name] == as_shown(getattr(frame, of_frame)), name
            assert values["valid"] == frame.valid.ravel().astype(int).tolist()
            assert [contact["id"] for contact in values["contacts"]] == [contact.id for contact in frame.contacts]
            expect(page.locator("#clock")).to_contain_text(f"frame {number + 1} of {len(frames)}")

        judge(0)
        for number in (len(frames) - 1, 70, 3, 120):
            at = (times[number] + times[min(number + 1, len(frames) - 1)]) / 2  # between two frames: the earlier one
            page.eval_on_selector(
                "#position", "(one, at) => { one.value = at; one.dispatchEvent(new Event('input')); }", float(at)
            )
            judge(number)
        page.click("#forward")
        judge(121)
        page.focus("#position")
        page.keyboard.press("ArrowLeft")
        judge(120)
        page.select_option("#speed", "20")
        page.click("#play")
        judge(len(frames) - 1)
        expect(page.locator("#play")).to_have_text("Play")

        page.evaluate("ohmskin.choose(1)")  # cell (0, 1), which is shorted near the end
        until(page, "ohmskin.chosen[0].series.length")
        samples = page.evaluate(SAMPLES)
        expected = [
            [time_s, frame.pressure[0, 1] if frame.valid[0, 1] else math.nan, frame.pressure_std[0, 1]]
            for time_s, frame in zip(times, frames, strict=True)
        ]
        np.testing.assert_array_equal(np.float32(samples)[:, 1:], np.float32(expected)[:, 1:])
        np.testing.assert_allclose(np.array(samples)[:, 0], times, atol=1e-9)


# What browsers send, without a browser.


@contextmanager
def still(**options: Any) -> Iterator[tuple[str, Script]]:
    """The page of a board that has said two frames, and its port."""
    port = Script(*board_says(range(2)))
    skin = Skin(port)
    with served(LiveSource(skin), **options) as url:
        yield url, port


def join(url: str, **options: Any) -> ClientConnection:
    """A WebSocket, as the page itself would open it."""
    parts = urlsplit(url)
    return connect(
        url.replace("http", "ws", 1) + "frames", **{"origin": f"http://{parts.netloc}", "proxy": None, **options}
    )


def answer_to(socket: ClientConnection, order: str | bytes) -> Any:
    """The next answer that is not a status: an object, or a frame as bytes."""
    socket.send(order)
    return next_answer(socket)


def next_answer(socket: ClientConnection) -> Any:
    while True:
        answer = socket.recv(timeout=HANG_S)
        if isinstance(answer, bytes):
            return answer
        message = json.loads(answer)
        if message["kind"] not in ("status", "handshake"):
            return message


def status_of(url: str, host: str, path: str | None = None, method: str = "GET") -> int:
    """The HTTP status of a request with a Host header of one's own."""
    parts = urlsplit(url)
    connection = HTTPConnection(parts.hostname or "", parts.port, timeout=HANG_S)
    connection.request(method, parts.path if path is None else path, headers={"Host": host})
    response = connection.getresponse()
    assert "default-src 'none'" in response.headers.get("Content-Security-Policy", "") or method != "GET"
    connection.close()
    return response.status


def test_on_the_loopback_only_its_own_names_and_page_are_answered() -> None:
    with still() as (url, _):
        port = urlsplit(url).port
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", url)
        for host in (f"127.0.0.1:{port}", f"localhost:{port}", "localhost:9", f"[::1]:{port}"):
            assert status_of(url, host) == 200, host
        for host in ("evil.example", f"127.0.0.1.evil.example:{port}", "192.0.2.7", "", "["):
            assert status_of(url, host) == 403, host
        assert status_of(url, "localhost", "/../../etc/passwd") == 404
        assert status_of(url, "localhost", "/_server.py") == 404
        with suppress(RemoteDisconnected):  # what older versions of websockets do
            assert status_of(url, "localhost", method="POST") == 405
        with join(url) as socket:
            assert json.loads(socket.recv())["kind"] == "handshake"
        for origin in ("http://evil.example", f"http://localhost:{port}", "null", None):
            with pytest.raises(InvalidStatus) as refused:
                join(url, origin=origin)
            assert refused.value.response.status_code == 403


def test_elsewhere_everything_needs_the_token(browser: Browser) -> None:
    with still(host="0.0.0.0") as (url, _):
        parts = urlsplit(url)
        token = parts.path.strip("/")
        assert len(token) >= 43, "32 random bytes"
        here = f"http://127.0.0.1:{parts.port}/{token}/"
        with opened(browser, here) as page:
            expect(page.locator("#state")).to_have_text("silent")
        for path in ("/", "/main.js", "/frames", f"/{token[:-1]}/", f"/{token}x/", "//", f"/x/{token}/"):
            assert status_of(here, "skin.example", path) == 403, path
        assert status_of(here, "skin.example", f"/{token}") == 301
        assert status_of(here, "skin.example") == 200
        with pytest.raises(InvalidStatus):
            join(f"http://127.0.0.1:{parts.port}/")
        with pytest.raises(InvalidStatus):
            join(here, origin="http://evil.example")
    with still(host="0.0.0.0") as (another, _):
        assert urlsplit(another).path.strip("/") != token


def test_junk_is_answered_in_one_line_and_harms_nobody() -> None:
    junk: list[str | bytes] = [
        "",
        "{",
        "[]",
        "null",
        '{"do": "format the disk"}',
        '{"do": "next"}',
        '{"do": "next", "after": 1e99}',
        '{"do": "next", "after": 0, "more": 1}',
        '{"do": "show time", "time_s": NaN}',
        '{"do": "show time", "time_s": 1}',
        '{"do": "trace", "cells": [[0, 0]], "points": 100}',
        '{"do": "trace", "cells": [[-1, 0]], "points": 100}',
        '{"do": "undo tare"}',
        "[" * 3000,
        '"\\u001b[31m\n"',
        b"\0\1\2",
    ]
    with still() as (url, port), join(url) as good, join(url) as bad:
        for message in junk:
            refusal = answer_to(bad, message)
            assert refusal["kind"] == "refused", message
            assert refusal["text"].isprintable()
            assert len(refusal["text"]) < 400
        bad.send("x" * 5000)
        with pytest.raises(ConnectionClosed):
            next_answer(bad)
        seen = number_of(answer_to(good, '{"do": "next", "after": -1}'))
        port.say(*board_says(range(2, 3))[2:])
        assert number_of(answer_to(good, json.dumps({"do": "next", "after": seen}))) == seen + 1


def number_of(message: bytes) -> int:
    """The number in a frame's message."""
    return int.from_bytes(message[4:8], "little")


def test_a_browser_that_does_not_read_gets_no_queue_and_holds_nobody_up() -> None:
    with still() as (url, port), join(url) as slow, join(url) as quick:
        first = number_of(answer_to(quick, '{"do": "next", "after": -1}'))
        slow.send(json.dumps({"do": "next", "after": first}))
        for k in range(1, 60):
            quick.send(json.dumps({"do": "next", "after": first + k - 1}))
            port.say(*board_says(range(k + 1, k + 2))[2:])
            assert number_of(next_answer(quick)) == first + k
        assert number_of(next_answer(slow)) == first + 1, "what it had asked for"
        newest = number_of(answer_to(slow, json.dumps({"do": "next", "after": first + 1})))
        assert newest == first + 59, "and then nothing between"


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(MissingExtra, match=r"pip install .*\[view\]"), still():
        pass


def test_a_port_in_use_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with still() as (url, _):
        taken = urlsplit(url).port
        with pytest.raises(InputError, match="in use"), still(ports=[taken]):
            pass
        with still(ports=[taken, 0]) as (another, _):
            assert urlsplit(another).port != taken
    with pytest.raises(InputError, match="no address of this machine"), still(host="192.0.2.1"):
        pass


def test_the_command_prints_the_address_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    file = tmp_path / "skin.toml"
    file.write_text(
        """
        [skin]
        [skin.design.array]
        rows = 2
        columns = 3
        [skin.design.drive]
        voltage = -1.0
        [skin.design.readout]
        circuit = "inverting-amplifier"
        reference_resistance = 20e3
        [skin.design.adc]
        bits = 10
        range = [-5.0, 5.0]
        """
    )
    Scene.load(file)
    command = [sys.executable, "-m", "ohmskin", "view", str(file), "--no-browser", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    with urllib.request.urlopen(url, timeout=HANG_S) as response:
        assert b"<title>ohmskin</title>" in response.read()
    with join(url) as socket:
        assert json.loads(socket.recv())["source"] == f"{file} (emulated)"
        assert isinstance(answer_to(socket, '{"do": "next", "after": -1}'), bytes)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=HANG_S)
    assert (process.returncode, out, err) == (130, "", "")


def test_the_map_fills_its_panel_and_nothing_is_cut_off(browser: Browser) -> None:
    with live() as board, opened(browser, board.url, viewport={"width": 1440, "height": 900}) as page:
        boxes = page.evaluate(
            "['#cells', '.skin', '#plot'].map((one) => document.querySelector(one).getBoundingClientRect().toJSON())"
        )
        cells, panel, plot = boxes
        assert cells["width"] * cells["height"] > 0.6 * panel["width"] * panel["height"]
        assert plot["bottom"] < 900
        assert page.evaluate("document.documentElement.scrollHeight") <= 900


def raw_status(url: str, request: bytes) -> int:
    """The HTTP status of any bytes."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port or 0), timeout=60) as client:
        client.sendall(request)
        answer = client.makefile("rb").readline()
    return int(answer.split()[1])


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_requests_that_contradict_themselves_are_bad_requests(host: str) -> None:
    with still(host=host) as (shown, _):
        url = f"http://127.0.0.1:{urlsplit(shown).port}{urlsplit(shown).path}"
        name, path = f"Host: {urlsplit(url).netloc}\r\n".encode(), urlsplit(url).path.encode()
        upgrade = (
            b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        )
        origin = b"Origin: http://" + urlsplit(url).netloc.encode() + b"\r\n"
        assert raw_status(url, b"GET %s HTTP/1.1\r\n%s\r\n" % (path, name)) == 200
        assert raw_status(url, b"GET %sframes HTTP/1.1\r\n%s%s%s\r\n" % (path, name, upgrade, origin)) == 101
        for request in (
            b"GET %sframes HTTP/1.1\r\n%s%s%s\r\n" % (path, name, upgrade, 2 * origin),
            b"GET %sframes HTTP/1.1\r\n%s%s%s\r\n" % (path, 2 * name, upgrade, origin),
            b"GET %sframes HTTP/1.1\r\n%s%sOrigin: http://[\r\n\r\n" % (path, name, upgrade),
            b"GET //[/ HTTP/1.1\r\n%s\r\n" % name,
            b"GET http://[ HTTP/1.1\r\n%s\r\n" % name,
            b"GET %s\xc3\xa4 HTTP/1.1\r\n%s\r\n" % (path, name),
            b"GET /\xff HTTP/1.1\r\n%s\r\n" % name,
        ):
            assert raw_status(url, request) == 400, request


def test_unauthenticated_connections_are_few_and_in_nobodys_way() -> None:
    """They come faster than they are closed; the page is served all the time, and those who came first are gone."""
    with still(host="0.0.0.0") as (shown, port), contextlib.ExitStack() as crowd:
        address = ("127.0.0.1", urlsplit(shown).port or 0)
        url = f"http://127.0.0.1:{address[1]}{urlsplit(shown).path}"
        before = len(os.listdir("/proc/self/fd"))
        with join(url) as browser:
            for number in range(4):
                clients = [crowd.enter_context(socket.create_connection(address, timeout=60)) for _ in range(100)]
                for client in clients[::2]:
                    client.sendall(b"GET / HTTP/1.1\r\nHost: ")
                assert status_of(url, urlsplit(url).netloc) == 200
                assert isinstance(answer_to(browser, f'{{"do": "next", "after": {number - 1}}}'), bytes)
                port.say(*board_says(range(number + 2, number + 3))[2:])
                if not number:
                    first = clients
            for client in first:
                with suppress(ConnectionError):
                    assert client.recv(100) == b""
            served_now = len(os.listdir("/proc/self/fd")) - before - 400
            assert served_now < 140, "of 400 that hold on, which are of this process, too"


def test_a_client_that_sends_nothing_is_hung_up_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.view._server.REQUEST_S", 0.2)
    with (
        still() as (url, _),
        socket.create_connection(("127.0.0.1", urlsplit(url).port or 0), timeout=60) as idle,
        socket.create_connection(("127.0.0.1", urlsplit(url).port or 0), timeout=60) as slow,
    ):
        slow.sendall(b"GET / HTTP/1.1\r\nHost:")
        for client in (idle, slow):
            with suppress(ConnectionError):
                assert client.recv(100) == b""


def test_a_browser_that_pings_and_reads_nothing_is_hung_up_on(caplog: pytest.LogCaptureFixture) -> None:
    """The library answers pings at once: what waits for a peer is bounded, and others are served."""
    ping = b"\x89\xfd" + bytes(4) + 125 * b"x"
    with still() as (url, _), join(url) as other, socket.socket() as deaf:
        parts = urlsplit(url)
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.settimeout(HANG_S)
        deaf.connect((parts.hostname, parts.port))
        deaf.sendall(
            f"GET /frames HTTP/1.1\r\nHost: {parts.netloc}\r\nOrigin: http://{parts.netloc}\r\n"
            "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n".encode()
        )
        with pytest.raises(ConnectionError):
            deaf.sendall(1_000_000 * ping)
        assert isinstance(answer_to(other, '{"do": "next", "after": -1}'), bytes)
    assert "it sends pings and reads no answers" in caplog.text


def test_what_asyncio_logs_of_unauthenticated_clients_does_not_reach_the_terminal(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Where there are too many open files it has much to say, once a second."""
    with still() as (url, _), contextlib.ExitStack() as waiting:
        address, limits = ("127.0.0.1", urlsplit(url).port or 0), resource.getrlimit(resource.RLIMIT_NOFILE)
        logging.getLogger("ohmskin.view").setLevel(logging.ERROR)
        client = waiting.enter_context(socket.socket())
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) - 1, limits[1]))
            client.connect(address)
            wait_until(lambda: any("accept" in record.message for record in caplog.records))
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        assert {record.name for record in caplog.records} == {"ohmskin.view"}
        assert status_of(url, urlsplit(url).netloc) == 200
