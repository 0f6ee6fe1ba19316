"""The truth file, whatever ends the run, and the score of recordings against it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import HANG_S, Patience

from ohmskin.cli import run
from ohmskin.emulator import Recording, Sample, Truth, TruthFile, score, score_text
from ohmskin.errors import InputError

ROOT = Path(__file__).parents[1]


def sample(k: int, shape: tuple[int, int] = (3, 2)) -> Sample:
    values = np.full(shape, float(k))
    return Sample(k, k / 10, values + 1, values + 2, values + 3, values.astype(np.uint32))


def test_a_failed_run_keeps_its_frames_and_one_without_frames_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    path.write_bytes(b"old")

    def fail(frames: int) -> None:
        with TruthFile(path, (3, 2)) as truth:
            for k in range(frames):
                truth.append(sample(k))
            raise KeyError

    with pytest.raises(KeyError):
        fail(0)
    assert path.read_bytes() == b"old"
    with pytest.raises(KeyError):
        fail(7)
    with np.load(path) as arrays:
        np.testing.assert_array_equal(arrays["sequence"], np.arange(7))
    assert [file.name for file in tmp_path.iterdir()] == ["t.npz"]


SCENE = """
skin.design = "prototype.toml"
board.frame_rate = 500.0
[[contact]]
cells = [[1, 2]]
sine = {mean_kpa = 5.0, amplitude_kpa = 3.0, frequency_hz = 2.0}
"""


def start_emulator(folder: Path) -> subprocess.Popen[str]:
    (folder / "prototype.toml").write_text((ROOT / "verification" / "prototype.toml").read_text())
    (folder / "scene.toml").write_text(SCENE)
    board = subprocess.Popen(
        [sys.executable, "-m", "ohmskin", "emulate", "scene.toml", "--tcp", ":0", "--truth", "t.npz"],
        cwd=folder,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert board.stdout is not None
    assert board.stdout.readline()
    spool = folder / "t.npz.spool.npy"
    patience = Patience()
    while not (spool.exists() and spool.stat().st_size > 5000):
        patience.spend()
        time.sleep(0.05)
    return board


def test_a_killed_emulator_leaves_its_frames(tmp_path: Path) -> None:
    board = start_emulator(tmp_path)
    board.kill()
    board.communicate(timeout=HANG_S)
    truth = Truth.load(tmp_path / "t.npz.spool.npy")
    assert len(truth.sequence) > 10
    np.testing.assert_array_equal(truth.sequence, np.arange(len(truth.sequence)))
    assert truth.pressure_kpa[:, 1, 2].max() > 2.0


def test_a_full_disk_is_named_with_the_spool_that_holds_the_frames(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk. What an earlier run has left is not overwritten."""
    (tmp_path / "prototype.toml").write_text((ROOT / "verification" / "prototype.toml").read_text())
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "t.npz.spool.npy").write_bytes(b"earlier")
    emulate = f"{sys.executable} -m ohmskin emulate scene.toml --truth t.npz --duration 30"
    limited = ["sh", "-c", f"ulimit -f 700; exec {emulate}"]
    done = subprocess.run(limited, cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S, check=False)
    (line,) = done.stderr.splitlines()
    assert (done.returncode, line.count("t.npz: cannot be written: File too large; t.npz.2.spool.npy holds")) == (2, 1)
    assert len(Truth.load(tmp_path / "t.npz.2.spool.npy").sequence) > 100
    assert (tmp_path / "t.npz.spool.npy").read_bytes() == b"earlier"


@pytest.mark.parametrize(
    ("name", "reason"), [("no/t.npz", "No such file"), (".", "is a directory"), (os.devnull, "no regular file")]
)
def test_a_truth_file_that_cannot_be_is_refused_before_the_run(tmp_path: Path, name: str, reason: str) -> None:
    with pytest.raises(InputError, match=re.escape(reason)), TruthFile(tmp_path / name, (3, 2)):
        pytest.fail("the run began")


FRAMES, SHAPE, FULL = 120, (8, 9), 15.5


def truth(**changes: Any) -> Truth:
    """One bump that presses and moves along, frames 100 ... 219 at 50 Hz."""
    rows, columns = np.mgrid[:8, :9]
    time_s = np.arange(FRAMES) / 50
    load = 10 * np.sin(np.pi * time_s / 2.4)[:, None, None] ** 2
    away = (rows - 4) ** 2 + (columns - (2 + 2 * time_s[:, None, None])) ** 2
    fields = {
        "sequence": np.arange(100, 100 + FRAMES),
        "time_s": time_s,
        "pressure_kpa": load * np.exp(-away / 2),
        "pitch_mm": 4.0,
        "full_scale_kpa": FULL,
    }
    return Truth(**(fields | changes))


def recording(**changes: Any) -> Recording:
    real = truth()
    fields: dict[str, Any] = {
        "sequence": real.sequence,
        "time": real.time_s + 1000.0,
        "pressure": real.pressure_kpa,
        "valid": np.ones(real.pressure_kpa.shape, dtype=bool),
    }
    return Recording(**(fields | changes))


def test_a_perfect_recording_scores_no_error() -> None:
    result = score(recording(), truth())
    assert (result.frames, result.lost_frames, result.repeated_frames, result.unknown_frames) == (FRAMES, 0, 0, 0)
    assert result.rmse_kpa == result.worst_kpa == result.contacts_missed == result.contacts_false == 0
    assert result.contacts > 80
    assert result.location_rms == pytest.approx(0.0, abs=1e-9)
    assert result.arrival_worst_ms == pytest.approx(0.0, abs=1e-6)
    assert result.delay_ms == pytest.approx(0.0, abs=1e-6)


def test_errors_are_where_and_as_large_as_they_are() -> None:
    pressure = truth().pressure_kpa.copy()
    pressure[:, 7, 0] += 0.5
    pressure[40, 4, 3] += 3.1
    result = score(recording(pressure=pressure), truth())
    assert result.worst_at == (140, 4, 3)
    assert result.worst_kpa == pytest.approx(3.1)
    assert result.worst_percent == pytest.approx(20.0)
    squares = FRAMES * 0.5**2 + 3.1**2
    assert result.rmse_kpa == pytest.approx(np.sqrt(squares / (FRAMES * 72)))


def test_a_recording_that_is_off_by_a_cell_is_off_by_the_pitch() -> None:
    moved = np.roll(truth().pressure_kpa, 1, axis=1)
    result = score(recording(pressure=moved), truth())
    assert result.location_rms == pytest.approx(4.0, rel=0.02)
    assert result.location_unit == "mm"
    bare = score(recording(pressure=moved), truth(pitch_mm=np.nan))
    assert (bare.location_rms, bare.location_unit) == (pytest.approx(1.0, rel=0.02), "cells")
    assert score(recording(pressure=moved), truth(), pitch_mm=10.0).location_rms == pytest.approx(10.0, rel=0.02)


def test_contacts_are_missed_and_imagined() -> None:
    none = score(recording(pressure=np.zeros((FRAMES, *SHAPE))), truth())
    assert none.contacts_missed == none.contacts > 0
    assert np.isnan(none.location_rms)
    pressure = truth().pressure_kpa.copy()
    pressure[:, 0, 8] = 9.0
    ghost = score(recording(pressure=pressure), truth())
    assert ghost.contacts_false == FRAMES
    assert ghost.contacts_missed == 0
    far = score(recording(pressure=np.roll(truth().pressure_kpa, 4, axis=1)), truth())
    assert far.contacts_missed > 0.5 * far.contacts
    assert far.contacts_false > 0.5 * far.contacts


def test_cells_that_read_as_pressed_at_rest_are_named_as_a_cause_of_false_contacts() -> None:
    real = truth()
    perfect = score(recording(), real)
    assert (perfect.rest_error_kpa, perfect.rest_contact_cells) == (0.0, 0)
    assert "tare" not in score_text(perfect)
    pressure = real.pressure_kpa.copy()
    pressure[:, :, 8] += 2.0  # 15.5 kPa is full scale
    pressure[::3, 0, 0] += 9.0  # a cell that is wrong now and then is at rest in the median
    result = score(recording(pressure=pressure), real)
    ever_at_rest = (real.pressure_kpa <= 0.155).any(axis=0)
    assert ever_at_rest[:, 8].all()
    assert result.rest_contact_cells == SHAPE[0]
    assert result.rest_error_kpa == pytest.approx(np.sqrt(SHAPE[0] * 2.0**2 / ever_at_rest.sum()))
    assert f"{SHAPE[0]} cells read above 10 % of full scale at rest" in score_text(result)
    assert "not tared" in score_text(result)
    always = score(recording(), truth(pressure_kpa=real.pressure_kpa + 1.0))
    assert np.isnan(always.rest_error_kpa)
    assert always.rest_contact_cells == 0
    assert "no cell is ever at rest" in score_text(always)


def test_losses_repeats_and_frames_of_others_are_counted() -> None:
    kept = np.r_[0:30, 40:FRAMES]
    real = truth()
    sequence = np.r_[real.sequence[kept], 130, 9999]
    pressure = np.concatenate([real.pressure_kpa[kept], real.pressure_kpa[[30, 0]]])
    sequence = np.r_[sequence, real.sequence[5]]
    pressure = np.concatenate([pressure, real.pressure_kpa[[5]]])
    some = recording(
        sequence=sequence, time=np.arange(len(sequence)) * 0.02, pressure=pressure, valid=np.isfinite(pressure)
    )
    result = score(some, truth())
    assert result.frames == FRAMES - 9
    assert (result.lost_frames, result.repeated_frames, result.unknown_frames) == (9, 1, 1)
    assert result.rmse_kpa == 0


def test_cells_that_the_host_does_not_vouch_for_do_not_count() -> None:
    pressure = truth().pressure_kpa.copy()
    pressure[:, 2, 2] = np.nan
    valid = np.ones(pressure.shape, dtype=bool)
    valid[:, 2, 2] = False
    result = score(recording(pressure=pressure, valid=valid), truth())
    assert result.worst_kpa == 0
    assert result.valid_percent == pytest.approx(100 * 71 / 72)


@pytest.mark.parametrize("frames", [0.0, 3.0, 7.5])
def test_the_delay_of_an_estimator_is_found(frames: float) -> None:
    real = truth()
    late = np.interp(np.arange(FRAMES) - frames, np.arange(FRAMES), real.pressure_kpa.sum(axis=(1, 2)))
    pressure = np.repeat(late[:, None, None], 72, axis=1).reshape(FRAMES, *SHAPE)
    expected = np.repeat(real.pressure_kpa.sum(axis=(1, 2))[:, None], 72, axis=1).reshape(FRAMES, *SHAPE)
    result = score(recording(pressure=pressure), truth(pressure_kpa=expected))
    assert result.delay_ms == pytest.approx(20.0 * frames, abs=2.0)


def test_arrival_is_counted_from_the_fastest_frame() -> None:
    arrived = truth().time_s + 5.0
    arrived[50] += 0.08
    assert score(recording(time=arrived), truth()).arrival_worst_ms == pytest.approx(80.0)
    fast = score(recording(time=arrived / 20.0), truth())
    assert np.isnan(fast.arrival_worst_ms)
    assert "did not run in real time" in score_text(fast)


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(InputError, match="expected the same array"):
        score(recording(pressure=np.zeros((FRAMES, 2, 2))), truth())
    with pytest.raises(InputError, match="not of the same run"):
        score(recording(sequence=np.arange(9000, 9000 + FRAMES)), truth())


def save(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def test_the_command_scores_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    real = truth()
    there = save(
        tmp_path / "truth.npz",
        **{name: getattr(real, name) for name in ("sequence", "time_s", "pressure_kpa", "pitch_mm", "full_scale_kpa")},
    )
    here = save(
        tmp_path / "r.npz",
        sequence=real.sequence.astype(np.uint32),
        time=real.time_s,
        pressure=(real.pressure_kpa + 0.1).astype(np.float32),
    )
    assert run(["score", str(here), str(there), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rmse_kpa"] == pytest.approx(0.1, rel=1e-4)
    assert found["frames"] == FRAMES
    assert run(["score", str(here), str(there)]) == 0
    assert "0.1 kPa, 0.65 % of full scale" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected an archive (.npz)"),
        (b"PK\x05\x06" + bytes(18), "has no array 'sequence'"),
        ({"sequence": [1.5], "time": [0.0], "pressure": [[[1.0]]]}, "expected whole numbers"),
        ({"sequence": [1, 2], "time": [0.0], "pressure": [[[1.0]]]}, "'time' has 1 frames, and 'sequence' 2"),
        ({"sequence": [1], "time": [np.nan], "pressure": [[[1.0]]]}, "'time' is nan at [0]; expected numbers"),
        ({"sequence": [1], "time": [0.0], "pressure": [[1.0]]}, "expected numbers (frames, rows, columns)"),
        ({"sequence": [1], "time": [0.0], "pressure": [[["a"]]]}, "expected numbers (frames, rows, columns)"),
        ({"sequence": [1], "time": [0.0], "pressure": [[[1.0]]], "valid": [1]}, "'valid' is int64 of shape (1,)"),
        (None, "No such file"),
    ],
)
def test_a_file_that_is_no_recording_is_refused_in_one_line(
    tmp_path: Path, content: Any, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "r.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        save(path, **content)
    assert run(["score", str(path), str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_long_record_takes_bounded_memory(tmp_path: Path) -> None:
    one, frames = sample(1, (32, 32)), 1000
    with TruthFile(tmp_path / "t.npz", (32, 32)) as truth:
        tracemalloc.start()
        for _ in range(frames):
            truth.append(one)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 1e6 < frames * 3 * one.volts.nbytes / 10
