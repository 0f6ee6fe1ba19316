"""Lines that still conduct, but not as the design says: cracked ones and bridged ones are told from loads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ohmskin.cell import Cell
from ohmskin.circuits import Design, Reason, adc_codes, recover, scan, scan_batch
from ohmskin.common.arrays import BoolArray, FloatArray
from ohmskin.driver import CountReader, Skin
from ohmskin.driver._line_faults import Creep, LineFaults
from ohmskin.driver._tuning import EVERY_S, OVERLOAD

REST_OHM, BEGIN, SHAPE = 18e3, 6, (8, 8)
CIRCUITS: dict[str, dict[str, Any]] = {
    "divider": {"circuit": "voltage-divider", "reference_resistance": 4.7e3},
    "amplifiers": {"circuit": "inverting-amplifier", "reference_resistance": 30e3, "supply": [-0.1, 3.3]},
    "row amplifiers": {"circuit": "row-amplifier", "reference_resistance": 30e3, "supply": [-0.1, 3.3]},
    "followers": {"circuit": "voltage-feedback", "reference_resistance": 4.7e3},
}
PAPER = Cell.example().replace(rest_resistance_ohm=REST_OHM)
ASYMMETRIC = Cell.model_validate(
    {
        "rest_resistance_ohm": REST_OHM,
        "full_scale_kpa": 30.0,
        "model": {
            "kind": "asymmetric",
            "e1_kpa": 90.0,
            "e2_kpa": 100.0,
            "e3_kpa": 300.0,
            "eta2_kpa_s": 400.0,
            "eta3_kpa_s": 18000.0,
        },
    }
)


def board(circuit: str, bits: int = 12) -> Design:
    """8 x 8 cells."""
    return Design.model_validate(
        {
            "array": {"rows": 8, "columns": 8, "row_lead": 25.0, "column_lead": 5.0, "row_segment": 0.1},
            "drive": {"voltage": -1.0 if "amplifiers" in circuit else 3.3},
            "readout": CIRCUITS[circuit],
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )


def loads(frames: int, *presses: tuple[Any, Any, float, int, int]) -> FloatArray:
    """(frames, 8, 8) shares of full scale: rows, columns, share, first frame and the one after the last."""
    share = np.zeros((frames, *SHAPE))
    for row, column, size, first, end in presses:
        share[first:end, row, column] += size
    return share


def taken(
    design: Design,
    cell: Cell,
    share: FloatArray,
    fault: dict[str, Any] | None = None,
    end: int = 10**6,
    noise: float = 0.5,
) -> list[BoolArray]:
    """Faulty cells (8, 8) after each frame, of cells under loads, whose fault is there from frame BEGIN to ``end``.

    ``noise`` is a standard deviation by the step of the ADC.
    """
    draw = np.random.default_rng(3)
    rest_ohm = REST_OHM * np.exp(0.03 * draw.standard_normal(SHAPE)) if fault else np.full(SHAPE, REST_OHM)
    dt_s = np.full(len(share), EVERY_S)
    ohms = cell.forward(SHAPE, rest_resistance_ohm=rest_ohm).run(dt_s, share * cell.full_scale_kpa)
    volts = scan_batch(design, ohms).volts
    if fault:
        volts[BEGIN:end] = scan_batch(design.replace(fault=[fault]), ohms[BEGIN:end]).volts
    assert design.adc is not None
    codes = adc_codes(design, volts + draw.normal(scale=noise * design.adc.step, size=volts.shape))
    read, lines = CountReader(design), LineFaults(rest_ohm, Creep(cell), rest_known=True)
    found = []
    for frame, counts in enumerate(codes):
        cells = lines.take(frame * 1.001 * EVERY_S, read(counts), None)
        found.append(np.zeros(SHAPE, dtype=bool) if cells is None else cells)
    return found


def crack(kind: str, ohm: float) -> tuple[dict[str, Any], BoolArray]:
    """A fault ahead of six cells, and these."""
    behind = np.zeros(SHAPE, dtype=bool)
    if kind == "broken-row":
        behind[2, 2:] = True
        return {"kind": kind, "place": [2, 2], "resistance": ohm}, behind
    behind[:6, 2] = True
    return {"kind": kind, "place": [5, 2], "resistance": ohm}, behind


@pytest.mark.parametrize("circuit", list(CIRCUITS))
def test_one_frame_does_not_tell_a_crack_from_a_load(circuit: str) -> None:
    # Two boards that no counts tell apart: one is cracked, the other is sound and pressed on the same cells.
    fault, behind = crack("broken-row", 1e3)
    design, cells = board(circuit), np.full(SHAPE, REST_OHM)
    volts = scan(design.replace(fault=[fault]), cells).volts
    pressed = recover(design, volts).resistance
    assert (adc_codes(design, scan(design, pressed).volts) == adc_codes(design, volts)).all()
    assert pressed[behind] == pytest.approx(1.32 * REST_OHM, rel=0.05)
    assert pressed[~behind] == pytest.approx(REST_OHM, rel=0.05)


@pytest.mark.parametrize("kind", ["broken-row", "broken-column"])
@pytest.mark.parametrize("circuit", list(CIRCUITS))
def test_a_line_that_cracks_is_told_from_a_load(circuit: str, kind: str) -> None:
    # Cells behind 1 kohm read 1.3 times their resistance. A load would creep; fingers on the line move all its cells.
    fault, behind = crack(kind, 1e3)
    share = loads(60, (2, 2, 0.4, 12, 24), (1, 5, 0.6, 3, 40))
    found = taken(board(circuit), PAPER, share, fault, end=50)
    assert not np.any(found[:BEGIN])
    assert any(np.array_equal(cells, behind) for cells in found[BEGIN : BEGIN + 35])
    assert not (np.any(found, axis=0) & ~behind).any()
    assert not np.any(found[52:]), "it is sound again"


@pytest.mark.parametrize("kind", ["broken-row", "broken-column"])
def test_what_no_load_gives_is_told_at_once(kind: str) -> None:
    # Cells behind r ohm read 1 + 6 r / R times their resistance R: here somewhat more than an overload makes of it.
    cell = PAPER.replace(full_scale_kpa=PAPER.full_scale_kpa / 3)
    at_once = cell.forward(()).step(0.01, cell.full_scale_kpa).item() / REST_OHM - 1.0
    fault, behind = crack(kind, 1.3 * OVERLOAD * at_once * REST_OHM / 6)
    found = taken(board("amplifiers"), cell, loads(12), fault)
    assert np.array_equal(found[BEGIN + 2], behind)


@pytest.mark.parametrize(("bits", "noise", "ohm", "looks"), [(12, 0.5, 100.0, 3), (10, 3.0, 1e3, 6), (8, 1.0, 30.0, 6)])
def test_bridged_columns_read_below_rest(bits: int, noise: float, ohm: float, looks: int) -> None:
    # The neighbour floats while a column is read, so that both read the cells of both. Rough readings tell in the mean.
    bridged = {"kind": "bridged-columns", "place": [0, 4], "resistance": ohm}
    found = taken(board("divider", bits), PAPER, loads(40, (2, 4, 0.6, 3, 25)), bridged, end=30, noise=noise)
    both = np.zeros(SHAPE, dtype=bool)
    both[:, 4:6] = True
    assert all(np.array_equal(cells, both) for cells in found[BEGIN + looks : 30])
    assert not np.any(found[32:])


@pytest.mark.parametrize("cell", [PAPER, ASYMMETRIC], ids=["paper", "asymmetric"])
@pytest.mark.parametrize("circuit", ["divider", "amplifiers"])
def test_loads_on_whole_lines_are_no_faults(circuit: str, cell: Cell) -> None:
    # Equal cells under equal pressures, which tell least: a bar on a row, twice; one on a column's end; hard ones.
    every = slice(None)
    presses = (
        ((2, every, 0.3, 6, 30), (2, every, 0.5, 45, 90)),
        ((slice(5), 3, 0.4, 6, 90), (1, 3, 0.4, 20, 40)),
        ((4, every, 1.5, 6, 50), (slice(4, 6), every, 0.2, 60, 90)),
        ((every, every, 0.5, 6, 60), (3, every, 0.3, 0, 30)),
    )
    for play in presses:
        assert not np.any(taken(board(circuit), cell, loads(90, *play)))
    # Released, cells of rough readings fall far below all that they read under the load, yet not below rest.
    assert not np.any(taken(board(circuit, 8), cell, loads(60, *presses[2]), noise=1.0))


def test_coarse_readings_do_not_tell() -> None:
    # A step of 8 bits is more than the creep: neither verdict is borne out, and cells stay valid.
    fault, _ = crack("broken-row", 1e3)
    assert not np.any(taken(board("divider", 8), PAPER, loads(110), fault))


def test_frames_say_so_and_their_recording_does(tmp_path: Path) -> None:
    scene, file = tmp_path / "scene.toml", tmp_path / "crack.mcap"
    scene.write_text(
        """
        [skin.design]
        array = { rows = 8, columns = 8, row_lead = 25.0 }
        drive = { voltage = -1.0 }
        readout = { circuit = "inverting-amplifier", reference_resistance = 20000.0, supply = [-0.1, 3.3] }
        adc = { bits = 12, range = [0.0, 3.3] }
        [board]
        frame_rate = 50.0
        noise = 0.0004
        [[event]]
        at_s = 1.0
        kind = "broken-row"
        place = [3, 0]
        resistance = 500.0
        """
    )
    with Skin.open(f"ohmskin://{scene}?clock=fast&duration=60", delivery="lossless", record=file) as skin:
        frames = [skin.read(5.0) for _ in range(230)]
        assert str(skin.stats().remark).startswith("row 3, columns 0 to 7: read what no load")
    assert frames[40].valid.all()
    for frame in frames[198:]:
        assert (frame.reason[3] == Reason.DISTURBED).all()
        assert frame.valid.sum() == 56
    with Skin.open(file) as skin:
        for frame, again in zip(frames, skin, strict=False):
            assert frame.sequence == again.sequence
            assert np.array_equal(frame.valid, again.valid)
            assert np.array_equal(frame.pressure, again.pressure)


# A follower's board with a broken row line and two shorted cells: nothing to be read, said in one remark


SCENE = """
[skin.design]
array = { rows = 8, columns = 8, row_segment = 0.3, column_segment = 0.3, row_lead = 25.0, column_lead = 5.0 }
drive = { voltage = 3.3 }
readout = { circuit = "voltage-feedback", reference_resistance = 10000.0 }
adc = { bits = 16, range = [0.0, 3.3] }

[board]
frame_rate = 100.0
noise = 0.0005

[[event]]
at_s = 0.0
kind = "broken-row"
place = [3, 0]

[[event]]
at_s = 0.0
kind = "shorted-cell"
place = [6, 2]

[[event]]
at_s = 0.0
kind = "shorted-cell"
place = [6, 5]
"""


def test_shorts_that_disturb_all_cells_are_named_in_a_remark(tmp_path: Path) -> None:
    """And in no other warning: an estimate that runs away to a short is none of the user's business."""
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    address = f"ohmskin://{scene}?clock=fast&duration=1.5&seed=7"
    with Skin.open(address, delivery="lossless") as skin:
        with pytest.warns(RuntimeWarning, match="look for shorted cells") as said:
            frames = list(skin)
        remark = skin.stats().remark
    assert len(said) == 1
    assert remark is not None
    assert "shorted cells" in remark
    assert not any(frame.valid.any() for frame in frames)
    assert (frames[-1].reason[6, [2, 5]] == Reason.SATURATED).all()
