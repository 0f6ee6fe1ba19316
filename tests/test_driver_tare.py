"""Tare: what it takes out, when it is refused, and that it can be kept and taken back."""

from __future__ import annotations

import re
import threading
import warnings
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, Script, Wire, described, frame, identity, lossless, scene, sheet, until
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ohmskin.bench._driver import design
from ohmskin.bench._paced_port import PacedPort, frame_packets
from ohmskin.cell import Cell, ContactModel
from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.config import parse
from ohmskin.driver import Skin, Tare
from ohmskin.driver._tare import EarlierRest, RestReadings
from ohmskin.emulator import Board
from ohmskin.errors import InputError

CELL = Cell.example()
REST = CELL.rest_resistance_ohm


def taken(resistance: np.ndarray, step_s: float = 0.02) -> RestReadings:
    return RestReadings(resistance, step_s * np.arange(len(resistance)))


def tare_of(resistance: np.ndarray, cell: Cell | None = CELL, noisy: np.ndarray | None = None) -> Tare:
    return replace(taken(resistance), noisy=noisy).tare(cell, lost=0, serial_number="A1", wall_time=1.0)


def at_rest(noise: float, spread: float, frames: int = 40, seed: int = 3) -> np.ndarray:
    """(frames, 8, 8) ohm: cells that differ by ``spread``, read with ``noise``, both relative."""
    rng = np.random.default_rng(seed)
    cells = REST * (1 + spread * rng.uniform(-1, 1, (8, 8)))
    return np.asarray(cells * (1 + noise * rng.standard_normal((frames, 8, 8))))


@pytest.mark.parametrize(("noise", "spread"), [(0.0, 0.0), (1e-2, 0.2)])
def test_an_unloaded_skin_is_tared(noise: float, spread: float) -> None:
    readings = at_rest(noise, spread)
    tare = tare_of(readings)
    assert tare.remarks == ()
    np.testing.assert_allclose(tare.rest_resistance_ohm, readings.mean(axis=0))
    np.testing.assert_allclose(tare.std_ohm, readings.std(axis=0, ddof=1), atol=1e-9)


def test_noise_that_hides_a_load_asks_for_more_frames() -> None:
    """As many as are enough, also where only some readings are valid."""
    valid, advised, frames = 0.3, [], 10
    for seed in range(10):
        random, readings = np.random.default_rng(seed), at_rest(0.2, 0.1, frames=1500, seed=seed)
        readings[random.random(readings.shape) > valid] = np.nan
        few = tare_of(readings[:frames])
        if few.remarks:
            assert "differ" in few.remarks[0]
            advised.append(few.frames_advised)
            assert tare_of(readings[frames : frames + few.frames_advised]).remarks == ()
    assert len(advised) >= 3
    assert min(advised) >= 2 * frames


def test_cells_that_scatter_widely_are_tared_with_the_spread_that_is_named() -> None:
    """12 x 20 cells whose logarithms scatter by 0.15: some are beyond 30 %, and a press is beyond all of them."""
    rng = np.random.default_rng(0)
    cells = REST * np.exp(rng.normal(0.0, 0.15, (12, 20)))
    readings = taken(cells * (1 + 1e-3 * rng.standard_normal((20, 12, 20))))
    tare = partial(readings.tare, CELL, lost=0, serial_number="A1", wall_time=1.0)
    refused = tare()
    assert len(refused.remarks) == 1
    assert 0.3 < refused.spread_advised < 1.0
    assert tare(spread=refused.spread_advised).remarks == ()
    readings.resistance_ohm[:, 3, 4] = 2.5 * np.median(cells)
    pressed = tare(spread=refused.spread_advised)
    assert len(pressed.remarks) == 1
    assert "1 cell differs from the others, most cell (3, 4)" in pressed.remarks[0]
    assert pressed.spread_advised == 0.0, "no scatter of cells explains it"


def test_a_skin_whose_cells_scatter_widely_names_the_spread() -> None:
    wide = {"design": DESIGN, "spread": {"rest_percent": 25.0, "seed": 2}}
    with lossless(Wire(Board(scene(skin=wide, contact=[])))) as skin:
        with pytest.raises(InputError, match=r"; tare\(spread=0\.\d\) if nothing is on it") as caught:
            skin.tare(10)
        named = float(re.findall(r"spread=(0\.\d)", str(caught.value))[0])
        assert skin.tare(10, spread=named).remarks == ()


@pytest.mark.slow
def test_a_divider_in_noise_says_how_many_frames_tell() -> None:
    """16 x 12 cells in 10 mV: one reading of thirty is valid, and known to a fifth or so."""
    board = design(16, "voltage-divider", "ground", 12).replace(array={"columns": 12})
    rng = np.random.default_rng(5)
    volts = scan(board, REST * np.exp(rng.normal(0.0, 0.05, (16, 12)))).volts
    codes = adc_codes(board, volts + 0.01 * rng.standard_normal((500, 16, 12)))
    port = PacedPort(frame_packets(codes, 100.0), 1e-3, board)
    port.work(60.0)
    with warnings.catch_warnings(), Skin(port, design=board, cell=CELL, delivery="lossless", timeout=60.0) as skin:
        warnings.simplefilter("ignore", RuntimeWarning)  # few valid cells
        said = r"no tare, though noise may be why 1 cell differs .* tare\((\d+)\), or tare\(force=True\)$"
        with pytest.raises(InputError, match=said) as caught:
            skin.tare()
        frames = int(re.search(r"tare\((\d+)\)", str(caught.value))[1])
        assert skin.tare(frames).remarks == ()


@pytest.mark.parametrize("valid", [0.3, 0.02])
def test_cells_that_noise_hides_ask_for_more_frames(valid: float) -> None:
    """As many as show nearly all of them, and none where all have been measured or no noise hides them."""
    random, readings = np.random.default_rng(1), at_rest(1e-3, 0.05, frames=3000)
    readings[random.random(readings.shape) > valid] = np.nan
    few = readings[: round(0.5 / valid)]  # the usual cell has half a reading
    tare = tare_of(few, noisy=np.ones((8, 8), dtype=np.bool_))
    assert not tare.measured.all()
    assert f"{tare.measured.sum()} of 64 cells measured, noise hides the others" in tare.covers
    assert f"tare({tare.frames_advised}) covers" in repr(tare)
    assert 6 < valid * tare.frames_advised < 12, "readings of the usual cell: of 8 one in 3000 has none"
    after = tare_of(readings[: tare.frames_advised], noisy=np.ones((8, 8), dtype=np.bool_))
    assert after.measured.mean() > 0.98
    assert tare_of(few).frames_advised == 0, "open cells"
    assert tare_of(at_rest(1e-3, 0.05), noisy=np.ones((8, 8), dtype=np.bool_)).frames_advised == 0


def test_one_pressed_cell_is_noticed() -> None:
    readings = at_rest(1e-3, 0.1)
    readings[:, 2, 5] *= 1.6
    (remark,) = tare_of(readings).remarks
    assert re.match(r"1 cell differs from the others, most cell \(2, 5\) with 1\.\d\d times their median", remark)


def test_a_press_on_the_whole_skin_is_noticed_by_the_data_sheet() -> None:
    (remark,) = tare_of(2.5 * at_rest(1e-3, 0.1)).remarks
    assert "times the 1e+04 ohm that the data sheet gives for rest" in remark
    assert tare_of(2.5 * at_rest(1e-3, 0.1), cell=None).remarks == ()


@pytest.mark.parametrize(("change", "noticed"), [(0.03, True), (0.01, False)])
def test_a_load_that_comes_or_goes_is_noticed(change: float, noticed: bool) -> None:
    """Where the halves of the tare differ by more than 1 %."""
    readings = at_rest(1e-3, 0.1)
    readings[:, 4, 4] *= np.linspace(1.0, 1.0 + change, len(readings))
    remarks = tare_of(readings).remarks
    assert len(remarks) == noticed
    assert all("the resistance of 1 cell is changing, most at cell (4, 4) by " in remark for remark in remarks)


def test_cells_that_are_not_read_take_the_data_sheet() -> None:
    readings = at_rest(1e-3, 0.1)
    readings[:, 0, 0] = np.nan
    readings[::2, 1, 1] = np.nan
    tare = tare_of(readings)
    assert tare.rest_resistance_ohm[0, 0] == REST
    assert not tare.measured[0, 0]
    assert tare.rest_resistance_ohm[1, 1] == pytest.approx(np.nanmean(readings[:, 1, 1]))
    with pytest.raises(InputError, match="no cell has a valid reading"):
        tare_of(np.full((5, 2, 2), np.nan))


@given(arrays(np.float64, st.tuples(st.integers(1, 5), st.just(2), st.just(3)), elements=st.floats(1.0, 1e7)))
def test_a_tare_saved_is_the_tare_loaded(tmp_path_factory: pytest.TempPathFactory, readings: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("tare") / "tare.npz"
    tare = taken(readings).tare(CELL, lost=None, serial_number="A1", wall_time=1.7e9)
    tare.save(path)
    again = Tare.load(path)
    for name in ("rest_resistance_ohm", "measured", "std_ohm"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tare, name))
    for name in ("frames", "lost", "serial_number", "wall_time", "remarks"):
        assert getattr(again, name) == getattr(tare, name)


def test_a_tare_prints_as_one_line_without_its_arrays() -> None:
    readings = np.full((5, 2, 3), 1e4) * [0.9, 1.0, 1.2]
    readings[:, 1, 2] = np.nan
    plain = taken(readings).tare(CELL, lost=None, serial_number="A\n1", wall_time=1.7e9)
    assert repr(plain) == (
        "<Tare of 2 x 3 cells over 5 frames, typically 10000 ohm: 5 of 6 cells measured; "
        "2023-11-14 22:13 UTC; board A\\n1>"
    )
    loaded = replace(plain, remarks=("one", "two"), serial_number="", measured=np.zeros((2, 3), dtype=np.bool_))
    assert repr(loaded) == "<Tare of 2 x 3 cells over 5 frames: 0 of 6 cells measured; 2023-11-14 22:13 UTC; 2 remarks>"


@pytest.mark.parametrize("content", [b"PK\x03\x04 broken", b"time_s,pressure_kpa\n0,1\n", None])
def test_what_is_no_tare_is_one_line(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "tare.npz"
    if content is not None:
        path.write_bytes(content)
    said = "is no saved tare: " if content is not None else "cannot be read: No such file"
    with pytest.raises(InputError, match=rf"tare\.npz: {said}") as caught:
        Tare.load(path)
    assert "\n" not in str(caught.value)
    assert "pickle" not in str(caught.value)


def unknown_lead() -> Design:
    """The design of a maker who forgot the switches."""
    return parse({**DESIGN, "array": {"rows": 3, "columns": 2}}, Design, source="design")


def test_a_tare_can_be_taken_back_and_used_again() -> None:
    with lossless(Wire(Board(scene(contact=[]))), design=unknown_lead()) as skin:
        before = next(skin)
        first = skin.tare(5)
        tared = next(skin)
        assert skin.tared is first
        assert tared.estimator_restarted
        assert skin.undo_tare() is None
        undone = next(skin)
        skin.use_tare(first)
        again = next(skin)
        assert skin.undo_tare() is None
        assert skin.undo_tare() is None
    with lossless(Wire(Board(scene(contact=[]))), design=unknown_lead()) as skin:
        never = list(islice(skin, 8))[-1]
    assert (before.pressure > 0.01).all()
    np.testing.assert_allclose(tared.pressure, 0.0, atol=1e-9)
    assert undone.sequence == never.sequence
    np.testing.assert_allclose(undone.pressure, never.pressure)
    assert (undone.pressure > 0.5 * before.pressure).all()
    np.testing.assert_allclose(again.pressure, 0.0, atol=1e-9)


def test_a_loaded_skin_is_not_tared_unless_told_to() -> None:
    """Row 1 of the scene's skin is pressed between 1 and 3 s; at 50 Hz, frame 100 is at 2 s."""
    with lossless(Wire(Board(scene()))) as skin:
        list(islice(skin, 100))
        with pytest.raises(InputError, match=r"skin seems to be loaded: 1 cell differs .* tare\(force=True\)"):
            skin.tare(10)
        assert skin.tared is None
        assert next(skin).pressure[1, 1] > 10
        forced = skin.tare(10, force=True)
        assert len(forced.remarks) == 1
        np.testing.assert_allclose(next(skin).pressure, 0.0, atol=0.5)


def even_load() -> Wire:
    """A skin that bears a fifth of full scale on every cell from 1 s on, until 3 s."""
    load = [[0.0, 0.0], [1.0, 0.0], [1.05, 4.0], [3.0, 4.0], [3.05, 0.0]]
    return Wire(Board(scene(contact=[{"cells": [[i, j] for i in range(3) for j in range(2)], "load_kpa": load}])))


def test_an_even_load_is_noticed_by_an_earlier_tare(tmp_path: Path) -> None:
    """At 50 Hz, frame 100 is at 2 s, frame 200 at 4 s. Alone, the loaded skin looks like another skin at rest."""
    with lossless(even_load()) as skin:
        earlier = skin.tare(20)
        list(islice(skin, 80))
        with pytest.raises(InputError, match=r"6 cells of 6 changed by more than 10 % since the tare of 20..-..-.. "):
            skin.tare(10)
        assert skin.tared is earlier
        assert skin.tare(10, drift=1.0).remarks == ()
        skin.undo_tare()
        (remark,) = skin.tare(10, force=True).remarks
        assert remark.startswith("6 cells of 6 changed by more than 10 %")
        assert skin.tare(10).remarks == (), "a tare that was forced is not compared with"
        list(islice(skin, 100))
        # The last tare was taken on the loaded skin: it must not keep the right one from being taken.
        assert skin.tare(10).remarks == ()
        earlier.save(tmp_path / "tare.npz")
    with lossless(even_load()) as skin:
        list(islice(skin, 100))
        assert skin.tare(10).remarks == ()
        skin.use_tare(Tare.load(tmp_path / "tare.npz"))
        with pytest.raises(InputError, match="since the tare of"):
            skin.tare(10)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_drift_since_an_earlier_tare_is_no_load(noise: float) -> None:
    """Neither 5 % on all cells nor noise; but 15 % on one cell, which the spread of manufacture would hide."""
    earlier = EarlierRest("then", at_rest(0.0, 0.2)[0], np.ones((8, 8), dtype=bool))
    readings = 1.05 * at_rest(noise, 0.2)
    assert taken(readings).tare(CELL, lost=0, serial_number="", wall_time=0.0, earlier=earlier).remarks == ()
    readings[:, 4, 4] *= 1.1
    (remark,) = taken(readings).tare(CELL, lost=0, serial_number="", wall_time=0.0, earlier=earlier).remarks
    assert re.match(r"1 cell of 64 changed by more than 10 % since then, most cell \(4, 4\) to 1\.1\d", remark)
    readings[:, 4, 4] = np.nan
    assert taken(readings).tare(CELL, lost=0, serial_number="", wall_time=0.0, earlier=earlier).remarks == ()


TOUCHING = Cell(
    rest_resistance_ohm=REST,
    full_scale_kpa=40.0,
    model=ContactModel(full_scale_resistance_ohm=600.0, exponent=0.9),
)
"""electrodes that merely touch: a load lowers their resistance"""


def under_load(resistance: np.ndarray, load: float) -> np.ndarray:
    """What such cells read under ``load``, a share of full scale (equation of ``ContactModel``)."""
    return np.asarray(1 / (1 / resistance + load**0.9 / 600.0))


@pytest.mark.parametrize("spread", [0.03, 0.3])
def test_touching_electrodes_under_a_load_are_not_tared(spread: float) -> None:
    readings = at_rest(1e-3, spread)
    assert tare_of(readings, TOUCHING).remarks == ()
    assert tare_of(3.0 * readings, TOUCHING).remarks == (), "electrodes that hardly touch"
    readings[:, 2, 5] *= 20.0  # an open contact beside the others is at rest
    assert tare_of(readings, TOUCHING).remarks == ()
    readings[:, 4, 4] = under_load(readings[:, 4, 4], 0.3)
    (remark,) = tare_of(readings, TOUCHING).remarks
    assert re.match(r"1 cell conducts as under a load, most cell \(4, 4\) as under 1[0-4] kPa", remark)


def test_a_tare_of_another_shape_is_refused() -> None:
    tare = tare_of(at_rest(0.0, 0.0))
    shapes = "a tare of 8 x 8 cells; this skin has 3 x 2"
    with lossless(Wire(Board(scene(contact=[])))) as skin, pytest.raises(InputError, match=shapes):
        skin.use_tare(tare)


def test_a_tare_of_another_board_is_refused_also_where_the_board_describes_itself_first() -> None:
    script = Script(sheet(), frame(0), frame(1))
    with lossless(script) as skin:
        assert skin.serial_number == ""
        later = threading.Timer(0.1, script.say, [identity(serial_number="B2")])
        later.start()
        with pytest.raises(InputError, match="a tare of board A1; this is board B2"):
            skin.use_tare(tare_of(np.full((5, 3, 2), REST)))
        later.join()


def test_frames_lost_during_a_tare_count() -> None:
    with lossless(described(*map(frame, [0, 1, 5, 6, 9, 10]))) as skin:
        next(skin)
        tare = skin.tare(4)
        after = next(skin)
    assert tare.lost == 5
    assert (after.sequence, after.lost_before, after.skipped_before) == (10, 5, 0)


def test_a_tare_takes_frames_of_now_and_not_those_that_wait() -> None:
    port = described(*map(frame, range(20)))
    with Skin(port, delivery="every") as skin:
        until(lambda: skin.stats().frames == 20)
        coming = threading.Timer(0.1, port.say, map(frame, range(20, 30)))
        coming.start()
        tare = skin.tare(3)
        coming.join()
        assert tare.frames == 3
        port.say(frame(30))
        until(lambda: skin.stats().frames == 31)
        after = next(skin)
        assert after.skipped_before == (after.sequence or 0) - 3


def test_after_a_tare_no_old_estimate_is_handed_out() -> None:
    port = described(frame(0))
    with Skin(port) as skin:
        assert skin.latest(60.0, timeout=10.0).sequence == 0
        skin.use_tare(Tare(np.full((3, 2), 2 * REST), np.ones((3, 2), bool), np.zeros((3, 2)), 1, 0, "A1", 0.0))
        port.say(frame(1))
        new = skin.latest(60.0, timeout=10.0)
        assert new.sequence == 1
        assert new.estimator_restarted


BOARD_4X4 = DESIGN | {"array": {"rows": 4, "columns": 4, "row_lead": 70.0}}


def pressed_after(frames: int) -> list[float]:
    """Pressures in kPa of a cell that is pressed with 9 kPa from frame 60 on, so many frames after a tare."""
    press = {"cells": [[1, 1], [1, 2], [2, 1], [2, 2]], "load_kpa": [[0.0, 0.0], [0.6, 0.0], [0.6, 9.0]]}
    what = scene(skin={"design": BOARD_4X4}, contact=[press], board={"frame_rate": 100.0})
    with lossless(Wire(Board(what))) as skin:
        list(islice(skin, 40 - frames))
        skin.tare(20)
        shown = [one for one in islice(skin, frames + 100) if one.device_time is not None and one.device_time > 0.6]
        assert shown[0].contacts, "a contact in its first frame"
        return [float(one.pressure[1, 1]) for one in shown]


def test_a_press_soon_after_a_tare_is_right_from_its_first_frame() -> None:
    """The frames of the tare have told the estimator that the skin is at rest."""
    later = pressed_after(30)
    for frames in (0, 3):
        np.testing.assert_allclose(pressed_after(frames), later, rtol=0.02)


def test_a_broken_line_is_left_out_of_a_tare_and_named() -> None:
    event = {"at_s": 0.0, "kind": "broken-row", "place": [3, 0]}
    what = scene(skin={"design": BOARD_4X4}, contact=[], event=[event], board={"frame_rate": 100.0, "noise": 0.01})
    with lossless(Wire(Board(what, seed=2))) as skin:
        tare = skin.tare(30)
    assert not tare.measured[3].any()
    assert tare.measured[:3].all()
    assert "12 of 16 cells measured, without row 3" in tare.covers


@pytest.mark.parametrize("loads_lower", [True, False])
def test_cells_that_read_no_current_at_rest_are_tared_if_loads_lower_their_resistance(loads_lower: bool) -> None:
    open_at_rest = {
        "rest_resistance_ohm": 1e8,
        "full_scale_kpa": 50.0,
        "model": {"kind": "contact", "full_scale_resistance_ohm": 1000.0, "exponent": 1.0},
    }
    cell: dict[str, Any] = open_at_rest if loads_lower else CELL.model_dump() | {"rest_resistance_ohm": 1e8}
    what = scene(skin={"design": BOARD_4X4, "cell": cell}, contact=[], board={"frame_rate": 100.0})
    with lossless(Wire(Board(what))) as skin:
        if loads_lower:
            tare = skin.tare(20)
            assert tare.remarks == ()
            assert tare.covers == "16 of 16 cells measured"
            np.testing.assert_array_equal(tare.rest_resistance_ohm, np.full((4, 4), 1e8))
        else:
            with pytest.raises(InputError, match="no cell has a valid reading"):
                skin.tare(20)


@pytest.mark.parametrize("times", [1e-3, 0.1, 0.5, 0.99, 1.02, 3.0, 10.0, 1e3])
def test_valid_cells_have_a_pressure_whatever_the_tare_and_a_new_tare_mends_it(times: float) -> None:
    """A resistance that no load makes of the one at rest stays known, and says why there is no pressure."""
    with lossless(Wire(Board(scene(contact=[])))) as skin:
        right = skin.tare(5)
        rest = times * right.rest_resistance_ohm
        skin.use_tare(replace(right, rest_resistance_ohm=rest))
        frames = list(islice(skin, 5))
        said = skin.stats()
        mended = skin.tare(5, force=True)
        after = next(skin)
    for seen in frames:
        assert np.isfinite(seen.pressure[seen.valid]).all()
        assert (seen.valid == (seen.reason == 0)).all()
        np.testing.assert_allclose(seen.resistance, right.rest_resistance_ohm, rtol=0.01)
    assert frames[-1].valid.all() == (0.01 < times < 3.0)
    if not frames[-1].valid.any():
        assert said.not_valid == {"beyond_model": 6}
    np.testing.assert_allclose(mended.rest_resistance_ohm, right.rest_resistance_ohm, rtol=0.01)
    assert after.valid.all()
    np.testing.assert_allclose(after.pressure, 0.0, atol=0.2)
